"use strict";
// The page: a list of episodes, the panels of one episode, and the timeline.

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 8, 16];
const MOST_LISTED = 500, MOST_BARS = 24, MOST_PLACES = 5;
const get = (id) => document.getElementById(id);
const state = { time: 0, step: -1, playing: false, speed: 1 };
let log, episode, scene, plots = [], images = [], bars = [];

/** Read the log's description, and show its first episode. */
async function start() {
  log = await unpack(embedded("log-data"));
  get("about").textContent = [log.environment, ...log.policies.slice(0, 5)].filter(Boolean).join(" \u00b7 ");
  state.speed = log.speed;
  get("loop").checked = log.loop;
  for (const speed of new Set([...SPEEDS, log.speed].sort((a, b) => a - b))) {
    get("speed").append(new Option(`${speed}\u00d7`, speed, false, speed === log.speed));
  }
  get("number").max = log.numbers.length - 1;
  document.querySelector("main").classList.toggle("single", log.numbers.length === 1);
  listen();
  await choose(Math.max(0, log.numbers.indexOf(log.first)));
  if (log.problem) report(log.problem);
}

/** Load and show the episode at an index of the log's columns. */
async function choose(index) {
  state.index = index;
  const number = log.numbers[index];
  list();
  try {
    let bytes = embedded("episode-data");
    if (!bytes) {
      const answer = await fetch(`episode/${number}`);
      if (!answer.ok) throw new Error(await answer.text());
      bytes = await answer.arrayBuffer();
    }
    const data = await unpack(bytes);
    if (index === state.index) show(data);
  } catch (error) {
    report(`episode ${number} cannot be shown: ${error.message}`);
  }
}

/** Show a problem above the panels; an empty text hides it. */
function report(text) {
  get("problem").textContent = text;
  get("problem").hidden = !text;
}

/** Build the panels of an episode. */
function show(data) {
  report(data.notes.join(" "));
  episode = data;
  get("name").textContent = document.title = `${log.name}, ${summary(state.index)}`;
  plots.forEach((plot) => plot.destroy());
  for (const id of ["images", "plots", "policies", "lines", "places"]) get(id).replaceChildren();
  get("view").hidden = !data.scene;
  images = data.images.map((image) => new ImageView(get("images"), image));
  plots = plotsOf(data);
  bars = [...dialsOf(data), ...data.policies.filter(({ preference }) => preference).flatMap(barsOf)];
  get("log").hidden = !data.lines.texts.length;
  const places = placesOf(data);
  get("look").hidden = !places.length;
  get("places").append(...places.map(placeLine));
  get("lines").append(...data.lines.texts.map((text, k) => lineOf(data.lines, text, k)));
  get("time").max = duration();
  if (data.scene) showScene(data.scene);
  begun = -1;
  showLabels();
  state.step = -1;
  seek(0);
}

/** Return the number, return, end and length of the episode at an index. */
function summary(index) {
  const end = log.reasons[log.reason[index]];
  const parts = [`return ${short(log.returns[index])}`, end, `${log.lengths[index]} steps`];
  return `episode ${log.numbers[index]}: ${parts.filter(Boolean).join(", ")}`;
}

function showScene(data) {
  try {
    scene ??= new SceneView(get("scene"), log);
    scene.resize();
    scene.load(data);
    follow(true);
  } catch (error) {
    scene = undefined;
    get("view").hidden = true;
    report("The 3D view needs WebGL, which this browser does not offer; all other panels work.");
  }
}

/** Create a dial for each element of a Box action, with marks for the log and each policy. */
function dialsOf({ actions, policies, is_discrete: isDiscrete }) {
  if (isDiscrete || !log.parts.length || log.parts.length > MOST_BARS) return [];
  const own = policies.filter((policy) => !policy.preference);
  const box = element("div", { className: "bars" }, element("h2", { textContent: "Action" }));
  const cells = log.parts.map((part, k) => {
    const seen = [row(actions, k), ...own.map(({ policy_action: command }) => row(command, k))];
    const [low, high] = log.limits[part] ?? ends(seen);
    const dial = element("span", { className: "dial", title: `${short(low)} to ${short(high)}` });
    const number = element("span", { className: "number" });
    const marks = seen.map((_, m) => element("i", { className: m ? "policy" : "" }));
    if (low * high < 0) {
      const zero = element("i", { className: "zero" });
      zero.style.left = `${(100 * -low) / (high - low)}%`;
      dial.append(zero);
    }
    dial.append(...marks);
    box.append(element("span", { className: "name", textContent: part, title: part }), dial, number);
    return (step) => {
      seen.forEach((values, m) => {
        const share = (values[step] - low) / (high - low || 1);
        marks[m].hidden = !Number.isFinite(share);
        marks[m].style.left = `${100 * Math.min(Math.max(share, 0), 1)}%`;
      });
      number.textContent = short(step < seen[0].length ? seen[0][step] : NaN);
    };
  });
  if (own.length) box.append(element("p", { className: "key", textContent: "dark: log; blue: policy" }));
  get("policies").append(box);
  return [(step) => cells.forEach((draw) => draw(step))];
}

/** Return the smallest and the largest finite number of some arrays. */
function ends(arrays) {
  const finite = arrays.flatMap((values) => Array.from(values).filter(Number.isFinite));
  const extreme = (choose, first) => finite.reduce((a, b) => choose(a, b), first);
  return [extreme(Math.min, Infinity), extreme(Math.max, -Infinity)];
}

/** Return a title with the name of the policy, if the log has several. */
function titled(title, { name }) {
  return name ? `${title}: ${name}` : title;
}

/** Create the bars with a policy's value of each action at this step. */
function barsOf(policy) {
  const count = policy.q.shape[0];
  if (count > MOST_BARS) return [];
  const hasValues = policy.q.some(Number.isFinite), values = hasValues ? policy.q : policy.preference;
  const box = element("div", { className: "bars" },
    element("h2", { textContent: titled(hasValues ? "Q-values" : "Probabilities", policy) }));
  const cells = Array.from({ length: count }, (_, k) => {
    const name = log.actions[k] ?? String(k);
    const made = [
      element("span", { className: "name", textContent: name, title: name }),
      element("span"), element("span", { className: "number" }),
    ];
    made[1].append(element("div", { className: "bar" }));
    box.append(...made);
    return made;
  });
  const scale = hasValues ? "; from the worst to the best of this step" : "";
  box.append(element("p", { className: "key", textContent: `bold: taken; blue: policy's action${scale}` }));
  get("policies").append(box);
  return [(step) => {
    const now = cells.map((_, k) => (step < values.shape[1] ? row(values, k)[step] : NaN));
    const [low, high] = hasValues ? ends([now]) : [0, 1];
    cells.forEach((cell, k) => draw(cell, k, now[k], (now[k] - low) / (high - low || 1), step));
  }];

  function draw([name, bar, number], k, value, share, step) {
    bar.firstChild.style.width = `${Number.isFinite(share) ? 100 * share : 0}%`;
    number.textContent = short(value);
    name.classList.toggle("taken", row(episode.actions, 0)[step] === k + log.first_action);
    bar.firstChild.classList.toggle("best", policy.policy_action[step] === k + log.first_action);
  }
}

/** Return the steps that are worth a look: the kind, the step and the text of each. */
function placesOf({ rewards, actions, policies, times }) {
  const places = [];
  const add = (kind, values, text) => {
    const found = Array.from(values, (value, step) => ({ kind, step, value })).filter(({ value }) => value > 0);
    found.sort((a, b) => b.value - a.value);
    places.push(...found.slice(0, MOST_PLACES).map((place) => ({ ...place, text: text(place.step) })));
  };
  for (const policy of policies) {
    const sizes = Array.from(policy.td_error, Math.abs);
    add(titled("TD error", policy), sizes, (step) => short(policy.td_error[step]));
    if (policy.preference) {
      const name = (action) => log.actions[action - log.first_action] ?? String(action);
      const gaps = Array.from(rewards, (_, step) => gapOf(policy, step, row(actions, 0)[step]));
      add(titled("disagreement", policy), gaps, (step) => `would take ${name(policy.policy_action[step])}`);
    } else {
      const change = (step) => log.parts.map((_, k) => row(policy.policy_action, k)[step] - row(actions, k)[step]);
      const distance = (step) => Math.hypot(...change(step));
      add(titled("disagreement", policy), Array.from(rewards, (_, step) => distance(step)),
        (step) => `commands differ by ${short(distance(step))}`);
    }
  }
  const drops = Array.from(rewards, (reward, step) => (step ? rewards[step - 1] - reward : 0));
  add("drop of the reward", drops, (step) => `${short(rewards[step - 1])} to ${short(rewards[step])}`);
  return places.map((place) => ({ ...place, time: times[place.step] }));
}

/** Return how much more a policy prefers its own action than the logged one. */
function gapOf({ q, preference, policy_action: chosen }, step, action) {
  const values = q.some(Number.isFinite) ? q : preference;
  return row(values, chosen[step] - log.first_action)[step] - row(values, action - log.first_action)[step];
}

function placeLine({ kind, step, text, time }) {
  const button = element("button", {
    textContent: `step ${step}  ${kind}: ${text}`, onclick: () => { play(false); seek(time); },
  });
  return element("li", {}, button);
}

function lineOf({ times, levels }, text, k) {
  const button = element("button", {
    textContent: `${times[k].toFixed(2)} s  ${text}`,
    className: levels[k] >= 30 ? "failed" : "",
    onclick: () => seek(times[k]),
  });
  return element("li", {}, button);
}

/** List the episodes, the current one marked. */
function list() {
  const key = get("order").value, order = [...log.numbers.keys()];
  if (key !== "numbers") order.sort((a, b) => log[key][a] - log[key][b]);
  const place = order.indexOf(state.index);
  const first = Math.max(0, Math.min(place - MOST_LISTED / 2, order.length - MOST_LISTED));
  const listed = order.slice(first, first + MOST_LISTED);
  state.order = order;
  get("list").replaceChildren(...listed.map((index) => {
    const end = element("span", {
      className: log.failures[log.reason[index]] ? "end failed" : "end",
      textContent: log.reasons[log.reason[index]],
    });
    const button = element("button", { onclick: () => choose(index) },
      element("span", { textContent: log.numbers[index] }),
      element("span", { textContent: `return ${short(log.returns[index])}` }),
      element("span", { textContent: `${log.lengths[index]} steps` }), end);
    const label = labelOf(log.numbers[index]);
    if (label.text) {
      const className = { true: "end succeeded", false: "end failed" }[label.success] ?? "end";
      button.append(element("span", { className, textContent: `label: ${label.text}` }));
    }
    if (index === state.index) button.setAttribute("aria-current", "true");
    return element("li", {}, button);
  }));
  get("list").querySelector("[aria-current]").scrollIntoView({ block: "nearest" });
  get("more").hidden = listed.length === order.length;
  get("more").textContent = `${listed.length} of ${order.length} episodes`;
  get("number").value = log.numbers[state.index];
}

function duration() {
  return episode.times[episode.times.length - 1];
}

/** Show a time in seconds from the start of the episode. */
function seek(time) {
  if (!episode) return;
  state.time = Math.min(Math.max(time, 0), duration());
  const step = Math.max(0, indexAt(episode.times, state.time + 1e-9));
  get("time").value = state.time;
  const clock = `${state.time.toFixed(2)} of ${duration().toFixed(2)} s, step ${step} of ${episode.rewards.length}`;
  get("clock").value = clock;
  get("time").setAttribute("aria-valuetext", clock);
  if (episode.scene) scene?.draw(state.time);
  plots.forEach((plot) => plot.draw(state.time, step));
  if (step === state.step) return;
  state.step = step;
  images.forEach((image) => image.draw(step));
  bars.forEach((draw) => draw(step));
  facts(step);
}

/** Write the action and the reward of a step, and the return so far. */
function facts(step) {
  const actions = [...Array(episode.actions.shape[0]).keys()].map((k) => row(episode.actions, k)[step]);
  const action = step === episode.rewards.length ? "\u2013"
    : (episode.is_discrete && log.actions[actions[0] - log.first_action]) || actions.slice(0, 8).map(short).join(", ");
  const hasDials = !episode.is_discrete && log.parts.length && log.parts.length <= MOST_BARS;
  const sums = { reward: short(episode.rewards[step]), "return so far": short(episode.sums[step]) };
  const rows = hasDials ? sums : { action, ...sums };
  if (step === episode.rewards.length) rows.end = log.reasons[log.reason[state.index]];
  get("facts").replaceChildren(...Object.entries(rows).flatMap(([name, value]) =>
    [element("dt", { textContent: name }), element("dd", { textContent: value })]));
}

function play(playing) {
  state.playing = playing;
  get("play").textContent = playing ? "Pause" : "Play";
  if (!playing) return;
  if (state.time >= duration()) seek(0);
  let last = performance.now();
  const tick = (now) => {
    if (!state.playing) return;
    seek(state.time + ((now - last) / 1000) * state.speed);
    last = now;
    if (state.time >= duration()) {
      if (!get("loop").checked) return play(false);
      seek(0);
    }
    requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
}

/** Move by a number of steps. */
function stepBy(count) {
  play(false);
  seek(episode.times[Math.min(Math.max(state.step + count, 0), episode.times.length - 1)]);
}

/** Show the episode that is `count` places further in the list. */
function turn(count) {
  const index = state.order[state.order.indexOf(state.index) + count];
  if (index !== undefined) choose(index);
}

function follow(following) {
  get("follow").setAttribute("aria-pressed", following);
  get("above").setAttribute("aria-pressed", false);
  scene?.fromAbove(false);
  scene?.follow(following);
}

function above(isAbove) {
  if (!isAbove) return follow(true);
  get("follow").setAttribute("aria-pressed", false);
  get("above").setAttribute("aria-pressed", true);
  scene?.fromAbove(true);
}

const KEYS = {
  " ": () => play(!state.playing),
  ArrowLeft: (event) => stepBy(event.shiftKey ? -10 : -1),
  ArrowRight: (event) => stepBy(event.shiftKey ? 10 : 1),
  Home: () => seek(0),
  End: () => seek(duration()),
  PageUp: () => turn(-1),
  PageDown: () => turn(1),
  ...LABEL_KEYS,
  f: () => follow(get("follow").getAttribute("aria-pressed") !== "true" || scene?.isTurned),
  a: () => above(get("above").getAttribute("aria-pressed") !== "true"),
};

function listen() {
  listenLabels();
  get("play").onclick = () => play(!state.playing);
  get("back").onclick = () => stepBy(-1);
  get("forth").onclick = () => stepBy(1);
  get("speed").onchange = ({ target }) => { state.speed = Number(target.value); target.blur(); };
  get("time").oninput = ({ target }) => seek(Number(target.value));
  get("follow").onclick = () => KEYS.f();
  get("above").onclick = () => KEYS.a();
  // The keys work again without a click elsewhere.
  get("order").onchange = ({ target }) => { list(); target.blur(); };
  get("number").onchange = ({ target }) => {
    const index = log.numbers.indexOf(Number(target.value));
    if (index >= 0) choose(index);
  };
  document.addEventListener("keydown", (event) => {
    const { target, key } = event;
    const isText = target.matches("select, input[type=number], input[type=text]");
    const isPressed = key === " " && target.matches("button, input[type=checkbox]");
    if (!episode || isText || isPressed || event.ctrlKey || event.metaKey || event.altKey || !KEYS[key]) return;
    event.preventDefault();
    KEYS[key](event);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    plots.forEach((plot) => plot.build());
    scene?.setColors();
  });
}

start().catch((error) => report(`the page cannot be shown: ${error.message}`));
