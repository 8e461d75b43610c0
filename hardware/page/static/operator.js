// The operator's page: what the camera sees, what the arm is about to do, and the answer.
//
// A button can be pressed only after its question was drawn and a beat of the program has come since,
// and no longer than beats come: an answer names the latest one.
import {connect} from "./connection.js";
import {$, make} from "./panel.js";
import {decode} from "./topdown.js";

const SILENCE = 2000; // ms without a beat, after which nothing can be answered
const SIGHT = 400; // ms that a question is seen before it is answered: a second click meant another one
const HEADS = {
  plan: "May the arm do this?", home: "May the arm move?", problem: "Something has to be cleared",
  task: "Something to do by hand", keep: "Keep this?", point: "Where to pick, and where to place?",
};
const KEYS = {yes: "Enter", another: "S"};

let hello = null, question = null, beat = null, sent = false, over = "", pictures = {}, picked = null, cursor = null;
let line = Promise.resolve(), link = 0; // messages one after the other; of which connection
const send = connect(hear, changed);

/** Take a message once those before it are done: pictures are decoded, which takes its time. */
function hear(message) {
  const of = link, came = performance.now();
  line = line.then(async () => {
    if (of !== link) return; // of a connection that was lost: the next one begins with a greeting
    await ({hello: greeted, look: looked, ask: asked, beat: beaten, closed, line: said, over: ended, note: refused})[message.kind](message, came);
    mark();
  }).catch(error => { console.error(error); });
}

function greeted(message) {
  hello = message;
  question = beat = null;
  over = message.over;
  $("title").textContent = `franka ${hello.verb}`;
  $("about").textContent = [hello.robot, `camera ${hello.camera}`, hello.agent && `${hello.agent} chooses`].filter(Boolean).join(" · ");
  $("lines").replaceChildren(...hello.lines.map(line => make("li", line)));
  $("lines").scrollTop = 1e6;
  show();
}

async function looked(message) {
  const {camera, above, mask, goal} = message;
  const [photograph, view] = await Promise.all([decode(camera, "image/jpeg"), decode(above)]);
  pictures = {camera: photograph, above: view};
  document.body.dataset.looks = message.actions;
  paint("mask", await decode(mask));
  $("goal-box").hidden = !goal;
  if (goal) paint("goal", await decode(goal));
  draw();
}

async function asked(message) {
  const of = link;
  question = message;
  beat = null;
  sent = false;
  question.drawn = 0;
  picked = cursor = null;
  $("refused").hidden = true;
  question.picture = message.plan ? await decode(message.plan) : null;
  if (of !== link) return; // the connection was lost while this was decoded
  draw();
  question.drawn = performance.now();
  show();
  if (question.which === "point") $("above").focus();
}

function beaten(message, came) {
  if (!question?.drawn || message.question !== question.number) return;
  beat = {number: message.beat, at: came};
  show();
}

function closed(message) {
  if (question?.number !== message.number) return;
  question = beat = null;
  document.activeElement?.blur();
  if (message.said) said({text: `answered: ${message.said}`});
  draw();
  show();
}

function said({text}) {
  $("lines").append(...text.split("\n").map(line => make("li", line)));
  while ($("lines").children.length > 100) $("lines").firstChild.remove();
  $("lines").scrollTop = 1e6;
}

function ended(message) {
  over = message.text;
  question = null;
  draw();
  show();
}

/** What the program did not take. */
function refused(message) {
  sent = false;
  $("refused").hidden = false;
  $("refused").textContent = message.text;
  show();
}

function changed(state) {
  link++;
  question = beat = null;
  const says = {
    open: "", lost: "Not connected; trying again. Nothing is answered meanwhile, and the arm does not begin anything that has to be asked for.",
    gone: "This address is no longer valid: open the one that the command printed when it started anew.",
  }[state];
  $("note").hidden = !says || Boolean(over);
  $("note").textContent = says;
  document.body.dataset.connection = state;
  show();
  return !over;
}

const fresh = () => Boolean(beat) && performance.now() - beat.at < SILENCE;
const open = () => document.body.dataset.connection === "open";
const seen = () => performance.now() - question.drawn > SIGHT;
const ready = () => Boolean(question) && !sent && fresh() && seen() && open();

function show() {
  const which = question?.which || "";
  $("ask").className = question ? `open ${which}` : "";
  $("head").textContent = over ? "It has ended" : question ? HEADS[which] : open() ? hello?.asks === false ? "At work, without asking" : "At work" : "Not connected";
  $("text").textContent = over || question?.text || "";
  document.title = `${question ? "● " : ""}franka ${hello?.verb || ""}`;
  const choices = question ? Object.entries(question.choices).filter(([says]) => says !== "stop") : [];
  if ($("choices").dataset.of !== String(question?.number)) {
    $("choices").dataset.of = question?.number;
    $("choices").replaceChildren(...choices.map(([says, words]) => {
      const button = make("button", `${words} `, {className: says, onclick: () => answer(says)});
      button.append(make("kbd", KEYS[says]));
      return button;
    }));
  }
  for (const button of $("choices").children) button.disabled = !ready();
  $("stop").disabled = Boolean(over) || !open();
  $("above").classList.toggle("aim", which === "point");
  mark();
}

function answer(says) {
  if (!ready() || !(says in question.choices)) return;
  sent = send({do: "answer", question: question.number, beat: beat.number, says});
  show();
}

function halt() { if (!over) send({do: "halt"}); }

/** The next point of a pick and place, by shares of the picture from above. */
function point(share) {
  if (!ready() || question.which !== "point") return;
  if (!picked) { picked = share; $("text").textContent = "now where it goes"; draw(); return; }
  const pixel = ([x, y]) => [y * question.rows - 0.5, x * question.columns - 0.5];
  sent = send({do: "point", question: question.number, beat: beat.number, pick: pixel(picked), place: pixel(share)});
  show();
}

// Drawing

function paint(id, picture) {
  const canvas = $(id);
  Object.assign(canvas, {width: picture.width, height: picture.height});
  canvas.getContext("2d").drawImage(picture, 0, 0);
}

function draw() {
  const way = question?.way || [];
  $("legend").hidden = $("side-box").hidden = !way.length;
  if (pictures.camera) {
    paint("camera", pictures.camera);
    if (way.length) drawWay($("camera").getContext("2d"), way);
  }
  const above = question?.picture || pictures.above;
  if (above) {
    paint("above", above);
    const c = $("above").getContext("2d"), at = ([x, y]) => [x * above.width, y * above.height];
    if (picked) ring(c, ...at(picked), "#ff5050");
    if (cursor) ring(c, ...at(cursor), "#ffffff");
  }
  if (way.length) drawSide(way);
  $("lines").scrollTop = 1e6; // their room has changed
}

function ring(c, x, y, color) {
  c.strokeStyle = color;
  c.lineWidth = 3;
  c.beginPath();
  c.arc(x, y, 9, 0, 7);
  c.moveTo(x - 16, y); c.lineTo(x + 16, y); c.moveTo(x, y - 16); c.lineTo(x, y + 16);
  c.stroke();
}

function drawWay(c, way) {
  const unit = c.canvas.width / 640;
  c.lineWidth = 2 * unit;
  c.strokeStyle = "#ffffff";
  c.setLineDash([6 * unit, 4 * unit]);
  c.beginPath();
  way.forEach(({pixel}, k) => c[k ? "lineTo" : "moveTo"](...pixel));
  c.stroke();
  c.setLineDash([]);
  for (const [name, color] of [["grasp", "#ff5050"], ["place", "#5adc5a"]]) {
    const {pixel} = way.find(each => each.name === name);
    c.strokeStyle = color;
    c.lineWidth = 2.5 * unit;
    c.beginPath(); c.arc(...pixel, 7 * unit, 0, 7); c.stroke();
  }
}

function drawSide(way) {
  const canvas = $("side"), ratio = devicePixelRatio, w = canvas.clientWidth, h = canvas.clientHeight;
  Object.assign(canvas, {width: w * ratio, height: h * ratio});
  const c = canvas.getContext("2d"), style = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  c.scale(ratio, ratio);
  const far = Math.max(way.at(-1).along, 1e-3), high = Math.max(...way.map(each => each.height)), edge = 120;
  const at = ({along, height}) => [edge + along / far * (w - 2 * edge), h - 16 - height / high * (h - 34)];
  c.strokeStyle = style("--line"); c.lineWidth = 1.5;
  c.beginPath(); c.moveTo(8, h - 16); c.lineTo(w - 8, h - 16); c.stroke();
  c.strokeStyle = style("--accent"); c.lineWidth = 2;
  c.beginPath();
  way.forEach((each, k) => c[k ? "lineTo" : "moveTo"](...at(each)));
  c.stroke();
  c.font = "11.5px system-ui, sans-serif";
  c.textBaseline = "middle";
  let below = {};
  for (const each of [...way].sort((a, b) => a.height - b.height)) {
    const left = each.along < far / 2, [x, y] = at(each), side = left ? "left" : "right";
    const line = Math.min(y, (below[side] ?? Infinity) - 13); // names do not lie over each other
    below[side] = line;
    c.fillStyle = style(each.name === "grasp" ? "--pick" : each.name === "place" ? "--place" : "--ink");
    c.beginPath(); c.arc(x, y, 3.5, 0, 7); c.fill();
    c.textAlign = left ? "right" : "left";
    c.fillText(`${each.name} ${Math.round(1000 * each.height)} mm`, x + (left ? -9 : 9), line);
  }
}

/** What tests wait for; a strict policy forbids evaluating scripts in the page. */
function mark() {
  Object.assign(document.body.dataset, {
    question: question?.number || "", which: question?.which || "", ready: ready(), over: Boolean(over), picked: Boolean(picked),
  });
}

$("stop").onclick = () => { halt(); document.activeElement.blur(); };
$("above").onclick = event => {
  const box = $("above").getBoundingClientRect();
  point([(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height]);
};
document.addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat && !event.key.startsWith("Arrow")) return;
  const key = event.key.toLowerCase();
  if (key === "q" || key === "escape") { halt(); return; }
  if (question?.which === "point") { aim(event); return; }
  if (event.target.tagName === "BUTTON" && (key === "enter" || key === " ")) return; // it is pressed itself
  if (key === "enter") answer("yes");
  else if (key === "s") answer("another");
});

/** Pointing by keys: arrows move the cross, by a pixel with Shift; Enter sets; Backspace takes back. */
function aim(event) {
  const step = event.shiftKey ? 1 : 8, moves = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]};
  const move = moves[event.key];
  if (move) {
    const clamp = share => Math.min(Math.max(share, 0), 1), [x, y] = cursor || [0.5, 0.5];
    cursor = [clamp(x + move[0] * step / question.columns), clamp(y + move[1] * step / question.rows)];
  } else if (event.key === "Enter" && cursor) point(cursor);
  else if (event.key === "Backspace") { picked = null; $("text").textContent = question.text; }
  else return;
  event.preventDefault();
  draw();
}
addEventListener("resize", draw);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
setInterval(() => { if (question && $("choices").firstChild?.disabled === ready()) show(); else mark(); }, 200);
show();
