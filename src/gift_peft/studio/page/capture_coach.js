// The Capture room's page. It asks again and again what there is to see (capture_room.py waits with the answer until
// there is a new picture), and shows it; the server takes the photos.
const $ = (selector) => element.querySelector(selector);
const pressing = [...element.querySelectorAll("[data-press]")];
const room = { state: "", seen: -1, version: -1, photos: 0, warned: "", wrong: null, said: "", groups: [], begins: false, ended: () => {} };
const LOST = "The studio does not answer: start it again. What was taken is kept.";
room.tab = sessionStorage.getItem("studio tab") || crypto.randomUUID();
sessionStorage.setItem("studio tab", room.tab);  // a reload is the same tab

async function ask(name, more = {}) {
  const answer = await server[name]({ tab: room.tab, ...more });
  return answer || { error: LOST, lost: true };  // gradio catches what fails, and gives nothing
}

function complain(text) {
  $(".wrong").textContent = text || "";
  $(".wrong").hidden = !text;
}

const wait = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
const same = (one, other) => JSON.stringify(one) === JSON.stringify(other);

let hearing;
function beep(tones) {  // whoever stands at the mirror does not see the screen
  if (!$(".sound").checked || !hearing) return;
  tones.forEach((tone, place) => {
    const source = hearing.createOscillator(), volume = hearing.createGain(), at = hearing.currentTime + 0.15 * place;
    source.frequency.value = tone;
    volume.gain.value = 0.1;
    source.connect(volume).connect(hearing.destination);
    source.start(at);
    source.stop(at + 0.12);
  });
}

// ---- what there is to see ----

function show(answer) {
  const runs = answer.state === "running", between = answer.state === "idle" || answer.state === "stopped";
  if (room.state !== answer.state) {
    const here = element.contains(document.activeElement);
    $(".begins").hidden = !between;
    $(".tools").hidden = !runs && !between;
    $(".live").hidden = !runs;
    $(".figures").hidden = !runs && answer.state !== "stopped";
    for (const button of pressing) button.disabled = !runs;
    if (runs) $(".live").focus();
    else if (room.state === "running" && here) $(".next").focus();  // what had it is no longer there
  }
  room.state = answer.state;
  if (answer.picture) { $(".picture").src = answer.picture; room.seen = answer.number; }
  for (const [name, text] of Object.entries(answer.figures || {})) $(`[data-figure=${name}]`).textContent = text;
  if (answer.of) $(".of").textContent = answer.of;
  $(".enough").hidden = !answer.enough;
  $(".count").textContent = answer.photos ?? 0;
  if (runs && answer.photos > room.photos) beep([880, 1320]);
  room.photos = answer.photos ?? 0;
  const warned = runs && answer.well === false ? answer.next : "";
  if (warned && !room.warned) beep([330]);
  room.warned = warned;
  const first = "Set up the camera on its tripod, name the group, and press Start.";
  const next = between ? (answer.told || []).join("\n") || (answer.wrong ? "" : first) : answer.next;
  if ($(".next").textContent !== next) $(".next").textContent = next;
  $(".next").classList.toggle("rests", between);
  $(".next").classList.toggle("warns", Boolean(warned));
  const said = (answer.said || []).join("\n");
  if (said !== room.said) {
    room.said = said;
    $(".log").replaceChildren(...(answer.said || []).map((line) => Object.assign(document.createElement("li"), { textContent: line })));
  }
  if ((answer.wrong || null) !== room.wrong) complain(room.wrong = answer.wrong || null);
  if (between) offer(answer);
  else $("[data-do=mask]").hidden = !(runs && answer.photos);
  if (runs || between) {
    if (answer.version !== room.version) { room.version = answer.version; strip(); }
  } else {
    room.seen = room.version = -1;  // another tab or another studio may show others
    if (answer.state === "elsewhere") $(".strip").replaceChildren();
  }
}

function offer(answer) {  // what may be begun now
  const splits = Object.keys(answer.free).filter(Boolean), select = $(".split");
  $(".splits").hidden = !splits.length;
  if (!same([...select.options].map((one) => one.value), splits)) select.replaceChildren(...splits.map((one) => new Option(one)));
  $(".group").placeholder = answer.free[select.value] || answer.free[""] || "";
  $(".source").textContent = /^\d+$/.test(answer.source) ? `camera ${answer.source}` : answer.source;
  $("[data-do=resume]").hidden = !answer.resumes;
  $("[data-do=mask]").hidden = !(answer.groups || []).length;
  room.groups = answer.groups || [];
}

async function strip() {
  const { photos = [] } = await ask("strip");
  $(".strip").replaceChildren(...photos.map((one) => {
    const item = document.createElement("li"), picture = new Image(), what = document.createElement("span");
    const name = document.createElement("span"), button = document.createElement("button");
    if (one.picture) picture.src = one.picture;
    picture.alt = one.name;
    what.className = "what";
    name.append(one.name.split("/")[0], "/", document.createElement("wbr"), one.name.split("/")[1]);
    button.type = "button";
    button.textContent = "Drop";
    button.setAttribute("aria-label", `Drop ${one.name}`);
    button.addEventListener("click", async () => complain((await ask("drop", { photo: one.name })).error));
    what.append(name, button);
    item.append(picture, what);
    return item;
  }));
  const lost = document.activeElement === document.body && $(".live").offsetParent;  // with the button that was pressed
  if (lost) $(".live").focus({ preventScroll: true });
}

async function watch() {
  while (element.isConnected) {
    const answer = await ask("look", { seen: room.seen });
    if (answer.lost) show({ state: "lost", next: LOST, photos: room.photos });
    else if (answer.error) complain(answer.error);
    else show(answer);
    if (room.state !== "running" || answer.error) { room.ended(); await wait(answer.lost ? 3000 : 1000); }
  }
}

// ---- what a person does ----

async function begin(name, more) {
  hearing = hearing || new AudioContext();
  if (room.begins) return;
  room.begins = true;
  const { error } = await ask(name, more);
  room.begins = false;
  complain(error);
  if (error) return;
  $(".group").value = "";
  $(".begins").hidden = true;  // from the second of two clicks
  room.state = "";
}

const actions = {
  start: () => begin("start", { group: $(".group").value, split: $(".split").value }),
  resume: () => begin("resume"),
  mask: async () => {
    if (room.state === "running") {
      room.groups = [];
      await press("end");
      await new Promise((resolve) => { room.ended = resolve; });
    }
    if (!room.groups.length) return;
    window.studioGroup = room.groups.at(-1);  // which the Masks room opens as soon as it is seen
    [...document.querySelectorAll("[role=tab], .overflow-dropdown button")].find((one) => one.textContent.trim() === "Masks").click();
  },
};

async function press(what) {
  if (room.state !== "running") return;
  complain((await ask("press", { what })).error);
}

for (const button of pressing) button.addEventListener("click", () => press(button.dataset.press));
for (const button of element.querySelectorAll("[data-do]")) button.addEventListener("click", () => actions[button.dataset.do]());
$(".group").addEventListener("keydown", (event) => event.key === "Enter" && actions.start());
const keys = { p: "photo", r: "reference", q: "end" };
element.addEventListener("keydown", (event) => {
  if (event.repeat) {  // a key that is held asks for one photo, and so does a button that it presses
    if (event.target.matches("button")) event.preventDefault();
    return;
  }
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("[type=text], select")) return;
  const what = keys[event.key.toLowerCase()];
  if (what) { event.preventDefault(); press(what); }
});
watch();
