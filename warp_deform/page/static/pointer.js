// Mouse, pen and keys: pick and place by two clicks or by a drag, in either view; the ring turns.

const STEP = 0.01, FINE = 0.002; // m: a press of an arrow key, and with Shift
const STILL = 5; // px: a press that moves less is a click

export class Hand {
  /**
   * `scene` may be null. `say` tells of a change of the plan: {pick, place, turn} or null;
   * `act(pick, place)` carries it out; `ready()` says whether the hand may act,
   * `begin()` the same of a press; `inside(xy)` says whether a point is on the table; `look(xy)` asks what the tip would take there.
   */
  constructor({scene, top, ready, begin, inside, say, act, look}) {
    Object.assign(this, {scene, top, ready, begin, inside, say, act, look, pick: null, turn: 0, from: null, mode: "", cursor: null});
    if (scene) this.listen(scene.canvas, event => scene.meant(event), event => scene.onTable(event), event => scene.onKnob(event), scene.orbit);
    this.listen(top.canvas, event => ({xy: top.at(event), thing: true}), event => top.at(event), event => top.onKnob(event), null);
  }

  listen(canvas, meant, onTable, onKnob, orbit) {
    canvas.addEventListener("pointerdown", event => {
      if (event.button !== 0) return;
      this.start = [event.clientX, event.clientY];
      this.mode = "";
      this.from = null;
      if (!this.begin()) { this.start = null; return; }
      if (this.pick && onKnob(event)) this.mode = "turn";
      else {
        const {xy, thing} = meant(event);
        this.from = xy;
        if (thing && !this.pick) this.mode = "drag";
      }
      if (this.mode) { canvas.setPointerCapture(event.pointerId); if (orbit) orbit.enabled = false; }
    }, {capture: true});
    canvas.addEventListener("pointermove", event => {
      const moved = this.start && Math.hypot(event.clientX - this.start[0], event.clientY - this.start[1]) > STILL;
      const here = onTable(event);
      if (this.cursor) { this.cursor = null; if (!this.pick) this.say(null); } // the pointer takes over
      if (this.mode === "turn" && here) this.setTurn(Math.atan2(here[1] - this.pick[1], here[0] - this.pick[0]));
      else if (this.mode === "drag" && moved && here) this.say({pick: this.from, place: here, turn: this.turn});
      else if (!event.buttons && this.ready()) {
        if (this.pick) this.say({pick: this.pick, place: here, turn: this.turn});
        else { const {xy} = meant(event); if (xy) this.look(xy); }
      }
    });
    canvas.addEventListener("pointerup", event => {
      const mode = this.mode, start = this.start;
      this.start = null; this.mode = "";
      if (orbit) orbit.enabled = true;
      if (event.button !== 0 || !start || mode === "turn" || !this.ready()) return;
      const moved = Math.hypot(event.clientX - start[0], event.clientY - start[1]) > STILL;
      if (moved && mode === "drag") this.carry(this.from, onTable(event));
      else if (!moved && this.pick) this.carry(this.pick, onTable(event));
      else if (!moved && this.from) this.choose(this.from);
    });
    canvas.addEventListener("pointerleave", () => { if (!this.pick) this.look(null); });
  }

  choose(xy) {
    if (!this.inside(xy)) return;
    this.pick = xy;
    this.say({pick: xy, place: null, turn: this.turn});
  }

  carry(pick, place) {
    if (!pick || !place || !this.inside(pick) || !this.inside(place)) return;
    if (this.act(pick, place)) this.drop();
  }

  /** Let the plan go. */
  drop() {
    this.pick = null;
    this.say(null);
  }

  /**
   * A key: arrows move the point that Enter or the space bar picks, and then places. Arrows go as the 3-D
   * view shows them; without one as the picture does. Returns whether it was one of these.
   */
  key(name, fine, bounds) {
    const [right, up] = this.scene ? this.scene.axes() : [[1, 0], [0, -1]];
    const way = {ArrowRight: right, ArrowLeft: right.map(x => -x), ArrowUp: up, ArrowDown: up.map(x => -x)}[name];
    if (way) {
      if (!this.ready()) return true;
      const from = this.cursor || this.pick || bounds.map(([low, high]) => (low + high) / 2);
      this.cursor = from.map((x, k) => Math.min(Math.max(x + way[k] * (fine ? FINE : STEP), bounds[k][0]), bounds[k][1]));
      if (this.pick) this.say({pick: this.pick, place: this.cursor, turn: this.turn});
      else { this.say({pick: this.cursor, place: null, turn: this.turn}); this.look(this.cursor); }
    } else if (name === "Enter" || name === " ") {
      if (!this.cursor || !this.begin()) return true;
      if (this.pick) this.carry(this.pick, this.cursor); else this.choose(this.cursor);
    } else return false;
    return true;
  }

  setTurn(angle) {
    this.turn = Math.atan2(Math.sin(angle), Math.cos(angle));
    if (this.pick) this.say({pick: this.pick, place: null, turn: this.turn});
    this.turned?.(this.turn);
  }
}
