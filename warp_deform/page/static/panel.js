// The panel beside the table: numbers, words and buttons.
import {decode} from "./topdown.js";

export const $ = id => document.getElementById(id);
export const make = (tag, text, more = {}) => Object.assign(document.createElement(tag), {textContent: text, ...more});

const OUTCOMES = {
  placed: "carried and let go",
  missed: "the tip met only the table",
  unreachable: "out of the arm's reach",
  invalid: "a guard of the physics fired",
};

/** What is said once, when the page is connected. */
export function introduce(hello) {
  document.title = `${hello.task} · warp-deform`;
  $("title").textContent = hello.task;
  $("score").title = hello.meaning;
  $("meaning").textContent = hello.meaning;
  $("instruction").textContent = hello.instruction;
  $("pull").hidden = !hello.gradients;
  $("ghost-box").hidden = !hello.goal;
  $("keep").hidden = !hello.records;
  $("next").textContent = hello.goal ? "Next goal" : "Next";
  $("lifts").hidden = hello.lifts.length < 2;
  $("who").replaceChildren(...hello.players.map(each => make("option", each.name, {value: each.name})));
}

/** Buttons for the lifts of a task's stages; `choose` is called with one. */
export function offerLifts(lifts, chosen, choose) {
  $("lifts").replaceChildren(make("span", "lift"), ...lifts.map((lift, k) => {
    const button = make("button", `${Math.round(100 * lift)} cm`, {type: "button", title: `key ${k + 1}`});
    button.setAttribute("role", "radio");
    button.setAttribute("aria-checked", lift === chosen);
    button.onclick = () => choose(lift);
    return button;
  }));
}

/** The state in numbers and words. */
export function tell(state, hello) {
  $("where").textContent = `${hello.robot} arm${hello.records ? ` · ${state.kept} kept` : ""}`;
  $("score").textContent = state.score.toFixed(3);
  $("bar").firstElementChild.style.width = `${100 * Math.min(Math.max(state.score, 0), 1)}%`;
  const words = state.over || (state.actions ? `action ${state.actions} of ${state.most}` : `${state.most} actions at most`);
  $("words").textContent = words;
  $("words").className = state.solved ? "solved" : state.over ? "bad" : "";
  const last = state.outcomes.at(-1);
  $("measures").textContent = [
    ...Object.entries(state.measures).map(([name, value]) => `${name} ${value.toFixed(2)}`),
    `${state.seconds.toFixed(1)} s simulated`,
    ...(last ? [OUTCOMES[last] || last] : []),
  ].join(" · ");
  $("physics").hidden = !state.physics;
  $("physics").textContent = state.physics && `The physics broke, so this state has no score: ${state.physics}. Undo, or start again.`;
  $("past").replaceChildren(...state.outcomes.map((outcome, k) => make("li", `${state.acted[k]}: ${OUTCOMES[outcome] || outcome}`)));
  $("undo").disabled = !state.actions;
  $("keep").disabled = !state.actions || Boolean(state.physics);
  $("keep").classList.toggle("call", state.solved);
  $("next").classList.toggle("call", state.solved && !hello.records);
  for (const id of ["step", "whole", "look"]) $(id).disabled = Boolean(state.over);
  $("seed").value = state.seed;
}

/** You beside others on the same seeds. */
export function rank(rows) {
  $("contest").hidden = !rows.length;
  $("contest").tBodies[0].replaceChildren(...rows.map(row => {
    const line = make("tr", "");
    line.append(make("td", row.seed), make("td", row.who), make("td", row.score.toFixed(3)), make("td", `${row.actions}${row.solved ? ", solved" : ""}`, {className: row.solved ? "solved" : ""}));
    return line;
  }));
}

/** Draw PNG bytes on one of the small canvases. */
export async function paint(id, bytes) {
  const picture = await decode(bytes), canvas = $(id);
  canvas.width = picture.width;
  canvas.height = picture.height;
  canvas.getContext("2d").drawImage(picture, 0, 0);
  return picture;
}

let fading = 0;

/** A line over the scene that goes by itself; empty takes it away. */
export function note(text, good = false, stays = false) {
  clearTimeout(fading);
  $("note").hidden = !text;
  $("note").textContent = text;
  $("note").classList.toggle("good", good);
  if (text && !stays) fading = setTimeout(() => note(""), 6000);
}
