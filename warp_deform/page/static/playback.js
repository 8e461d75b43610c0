// Clips one after the other on one time line: play, pause, faster, slower, scrub.

const LONGEST_STEP = 0.25; // s of playback: a hidden tab gets no frames, and would jump

export class Playback {
  /** `show(clip, frame)` draws; `ended(clip)` is called when a clip's end is reached by playing. */
  constructor(show, ended) {
    Object.assign(this, {show, ended, clips: [], now: 0, at: 0, playing: false, speed: 2});
  }

  get clip() { return this.clips[this.at]; }

  get length() { return this.clips.reduce((sum, clip) => sum + clip.end, 0); }

  /** Seconds from the beginning of the first clip. */
  get time() { return this.clips.slice(0, this.at).reduce((sum, clip) => sum + clip.end, 0) + this.now; }

  /** The beginning of a motion whose rest is still computed: it waits at its end. */
  get open() { const last = this.clips.at(-1); return last?.open ? last : null; }

  get finished() { return !this.clip || (!this.clip.open && this.at === this.clips.length - 1 && this.now >= this.clip.end); }

  /** Keep the clips of `actions` actions of an episode alone; the last state stands. */
  keep(seed, actions) {
    this.clips = this.clips.filter(clip => !clip.open && clip.seed === seed && clip.actions <= actions);
    this.at = Math.max(0, this.clips.length - 1);
    this.now = this.clip ? this.clip.end : 0;
    this.playing = false;
  }

  add(clip) {
    const waits = this.finished;
    this.clips.push(clip);
    if (waits) { this.at = this.clips.length - 1; this.now = 0; this.playing = true; this.draw(); }
  }

  /** The whole of a motion, instead of its beginning where that is shown; returns what is kept. */
  complete(clip) {
    const open = this.open;
    if (open) return Object.assign(open, clip, {open: false});
    this.add(clip);
    return clip;
  }

  draw() {
    if (this.clip) this.show(this.clip, Math.min(Math.round(this.now * this.clip.fps), this.clip.frames - 1));
  }

  toggle() {
    if (!this.clip) return;
    if (this.finished) this.scrub(0);
    this.playing = !this.playing;
  }

  scrub(share) {
    this.playing = false;
    let left = share * this.length;
    this.at = 0;
    while (this.at < this.clips.length - 1 && left > this.clip.end) left -= this.clips[this.at++].end;
    if (share >= 1) [this.at, left] = [Math.max(0, this.clips.length - 1), Infinity]; // no rounding
    this.now = this.clip ? Math.min(left, this.clip.end) : 0;
    this.draw();
  }

  /** Go to the end at once. */
  finish() {
    while (this.clip && !this.finished) {
      this.now = this.clip.end;
      this.draw();
      if (this.clip.open) return;
      this.ended(this.clip);
      if (this.at < this.clips.length - 1) { this.at++; this.now = 0; }
    }
    this.playing = false;
  }

  tick(seconds) {
    if (!this.playing || !this.clip || this.clip.open && this.now >= this.clip.end) return;
    this.now += Math.min(seconds, LONGEST_STEP) * this.speed;
    if (this.now >= this.clip.end) {
      const over = this.clip;
      this.now = over.end;
      this.draw();
      if (over.open) return;
      if (this.at < this.clips.length - 1) { this.at++; this.now = 0; } else this.playing = false;
      this.ended(over);
    } else this.draw();
  }
}
