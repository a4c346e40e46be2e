"use strict";
// Labels of episodes and steps. The server of the page saves them as `mcaprl label` does.

const NO_SERVER = "To save labels, open the log by: mcaprl replay LOG --browser";
const SAVING = "S success, X failure, B and E begin and end an interval, N note. Saved beside the log at once.";
// The first step of an interval that has no end yet; -1 if there is none.
let begun = -1;

/** Connect the buttons. */
function listenLabels() {
  get("saving").textContent = log.token ? SAVING : NO_SERVER;
  get("label-tools").hidden = !log.token;
  get("success").onclick = () => LABEL_KEYS.s();
  get("failure").onclick = () => LABEL_KEYS.x();
  get("begin").onclick = () => LABEL_KEYS.b();
  get("end").onclick = () => LABEL_KEYS.e();
  get("unlabel").onclick = () => saveLabel({ remove: true });
  get("note").onchange = ({ target }) => { if (target.value) saveLabel({ note: target.value }); };
  for (const id of ["note", "interval"]) {
    // Enter saves the note, and the keys work again.
    get(id).onkeydown = ({ key, target }) => { if (["Enter", "Escape"].includes(key)) target.blur(); };
  }
}

const LABEL_KEYS = {
  s: () => saveLabel({ success: true }),
  x: () => saveLabel({ success: false }),
  b: () => { begun = Math.min(state.step, episode.rewards.length - 1); markLabels(); },
  e: () => endInterval(),
  n: () => get("note").focus(),
};

/** Save the interval from the step at which it began to this one. */
function endInterval() {
  if (begun < 0) return report("an interval begins with the key B");
  const [first, last] = [begun, Math.min(state.step, episode.rewards.length - 1)].sort((a, b) => a - b);
  saveLabel({ interval: get("interval").value.trim(), steps: [first, last + 1] });
}

/** Send a change of the shown episode's labels to the server, and show what it saved. */
async function saveLabel(change) {
  if (!log.token) return report(NO_SERVER);
  try {
    const answer = await fetch("label", {
      method: "POST",
      headers: { "Content-Type": "application/json", "X-Label-Token": log.token },
      body: JSON.stringify({ episode: log.numbers[state.index], ...change }),
    });
    if (!answer.ok) throw new Error(await answer.text());
    log.labels = await answer.json();
    if (change.steps) begun = -1;
    report("");
    list();
    showLabels();
  } catch (error) {
    report(`the label was not saved: ${error.message}`);
  }
}

function intervalsOf(number) {
  return log.labels.intervals.filter((one) => one.episode === number);
}

/** Return a short text of an episode's labels, and whether it succeeded; undefined if unknown. */
function labelOf(number) {
  const { success, notes } = log.labels, parts = intervalsOf(number).length;
  const words = [{ true: "success", false: "failure" }[success[number]], notes[number],
    parts && (parts === 1 ? "1 interval" : `${parts} intervals`)];
  return { text: words.filter(Boolean).join(", "), success: success[number] };
}

/** Show the labels of the shown episode. */
function showLabels() {
  const number = log.numbers[state.index], { success, notes } = log.labels;
  get("success").setAttribute("aria-pressed", success[number] === true);
  get("failure").setAttribute("aria-pressed", success[number] === false);
  get("note").value = notes[number] ?? "";
  const { text, success: succeeded } = labelOf(number);
  const result = element("li", {
    className: { true: "succeeded", false: "failed" }[succeeded] ?? "", textContent: text,
  });
  get("intervals").replaceChildren(...(text ? [result] : []), ...intervalsOf(number).map((one) => {
    const seeks = element("button", {
      className: "seek", textContent: `${one.name}: steps ${one.start} to ${one.stop - 1}`,
      onclick: () => { play(false); seek(episode.times[one.start]); },
    });
    return element("li", {}, seeks);
  }));
  markLabels();
}

/** Mark the intervals on the timeline. */
function markLabels() {
  const place = (start, stop, name, className) => {
    const mark = element("i", { textContent: name, title: name, className }), { times } = episode;
    mark.style.left = `${(100 * times[start]) / (duration() || 1)}%`;
    mark.style.width = `${(100 * (times[stop] - times[start])) / (duration() || 1)}%`;
    return mark;
  };
  const marks = intervalsOf(log.numbers[state.index])
    .filter(({ stop }) => stop < episode.times.length)
    .map(({ start, stop, name }) => place(start, stop, name, ""));
  if (begun >= 0) marks.push(place(begun, begun + 1, "", "open"));
  get("marks").replaceChildren(...marks);
}
