// The Masks room's page. It keeps a list of edits, the server draws them (mask_edits.py says what one is), and shows
// what comes back. `element` is this room, `server` its Python functions.
const $ = (selector) => element.querySelector(selector);
const canvas = $("canvas"), pen = canvas.getContext("2d"), brush = $(".brush");
const room = { group: "", view: null, photo: "", own: "", place: "", version: "", edits: [], tool: "hit", corners: [], stroke: null,
  cross: [0.5, 0.5], crossing: false, zoom: 1, saving: false, shown: { heat: false, mask: true, blink: false }, pictures: {}, asked: 0 };

function say(text, wrong = false) {
  $(".said").textContent = text;
  $(".said").classList.toggle("wrong", wrong);
}

async function ask(name, more = {}) {
  const lost = "The studio does not answer: start it again. What was saved is kept.";
  const answer = (await server[name]({ group: room.group, ...more })) || { error: lost };  // gradio catches what fails
  if (answer.error && !answer.conflict) say(answer.error, true);
  return answer;
}

const about = (photo = room.own) => (photo ? { photo } : {});
const stored = () => `studio ${room.place}`;  // a file: other folders have groups of the same names
const here = ({ group, own }) => group === room.group && own === room.own;

function keep() {  // unsaved edits outlive a reload of this tab
  sessionStorage.setItem(stored(), JSON.stringify({ version: room.version, edits: room.edits }));
}

function take(state) {  // a saved mask to begin with, and what this tab had drawn on it
  room.place = state.place;
  const before = JSON.parse(sessionStorage.getItem(stored()) || "{}");
  room.version = state.version;
  room.edits = before.edits || [];
  room.corners = [];
  $(".conflict").hidden = true;
  const other = before.version === state.version ? "" : " The mask was changed meanwhile: yours is added to it, and Undo takes that back.";
  $(".overlay").src = state.overlay;
  if (state.problem) say(state.problem, true);
  return room.edits.length ? draw(other) : undefined;
}

// ---- groups and photos ----

async function list() {
  const { groups } = await ask("groups");
  if (!groups) return undefined;
  $(".group").replaceChildren(...groups.map((one) => new Option(`${one.done ? "✓" : "○"} ${one.name}: ${one.state}`, one.name)));
  const wanted = window.studioGroup || room.group;  // where the Capture room has taken photos
  window.studioGroup = undefined;
  const first = groups.find((one) => one.name === wanted) || groups.find((one) => !one.done) || groups[0];
  if (first) $(".group").value = first.name;
  return first && first.name;
}

async function open(name, quiet = false) {
  const asked = ++room.asked;
  room.group = name;
  if (!quiet) {
    room.own = room.photo = "";
    room.view = null;
    say("Opening the group.");
  }
  const watch = setInterval(async () => {
    const { said } = (await server.progress({ group: name })) || {};
    if (said && !room.view) say(`${said[0].toUpperCase()}${said.slice(1)} ...`);
  }, 700);
  const view = await ask("open");
  clearInterval(watch);
  if (asked !== room.asked || view.error) return false;
  room.view = view;
  room.pictures = {};
  room.photo = view.photos.some((one) => one.name === room.photo) ? room.photo : view.photos.at(-1).name;
  $(".for").replaceChildren(new Option("all photos of the group", ""), ...view.photos.map((one) => new Option(`${one.name} alone`, one.name)));
  $(".for").value = room.own;
  $(".heat").src = view.heat;
  $(".verdict").textContent = view.verdict.join("; ");
  [canvas.width, canvas.height] = view.size;
  if (!quiet) {
    const more = view.compares ? "" : " Nothing can be compared here: a click goes by color.";
    say(`Click on the mirror or glass.${more}`);
    await take(view);
  }
  strip();
  await show();
  return true;
}

function strip() {
  const shared = room.own ? room.view.overlay : $(".overlay").src;
  $(".strip").replaceChildren(...room.view.photos.map((one) => {
    const item = document.createElement("li"), button = document.createElement("button");
    const thumb = document.createElement("span"), what = document.createElement("span");
    const picture = new Image(), over = new Image();
    picture.src = one.picture;
    picture.alt = "";
    over.src = one.name === room.own ? $(".overlay").src : one.overlay || shared;
    over.alt = "";
    over.hidden = !room.shown.mask;
    thumb.className = `thumb ${one.status}`;
    thumb.append(picture, over);
    what.className = "what";
    what.textContent = [`${one.name}: ${one.says}`, ...(one.own ? ["a mask of its own"] : []), ...one.texts].join("; ");
    button.type = "button";
    button.append(thumb, what);
    button.setAttribute("aria-pressed", one.name === room.photo);
    button.addEventListener("click", () => { room.photo = one.name; room.own ? choose(one.name) : (strip(), show()); });
    item.append(button);
    return item;
  }));
}

async function show() {
  const key = `${room.photo} ${Boolean(room.own)}`;
  if (!(key in room.pictures)) {
    const group = room.group, answer = await ask("photo", { photo: room.photo, own: Boolean(room.own) });
    if (answer.error || group !== room.group) return;
    room.pictures[key] = answer.picture;
  }
  $(".photo").src = room.pictures[key];
  $(".photo").alt = room.photo;
  $(".heat").hidden = !room.shown.heat || Boolean(room.own);
  $(".overlay").hidden = !room.shown.mask;
  for (const button of element.querySelectorAll("[data-tool]")) button.setAttribute("aria-pressed", button.dataset.tool === room.tool);
  for (const button of element.querySelectorAll("[data-show]")) button.setAttribute("aria-pressed", room.shown[button.dataset.show]);
  $(".paper").style.width = `${room.zoom * 100}%`;
  $(".paper").style.maxWidth = room.zoom > 1 ? "none" : `calc(75vh * ${canvas.width / canvas.height})`;
  sketch();
}

async function choose(own) {  // what the mask is for: all photos, or one
  if (!room.view) return;
  room.own = own;
  $(".for").value = own;
  if (own) room.photo = own;
  const at = { group: room.group, own }, answer = await ask("start", about());
  if (answer.error || !here(at)) return;
  say(own ? `This mask is for ${own} alone; the photo is shown as it was taken.` : "This mask is for all photos.");
  await take(answer);
  strip();
  await show();
}

// ---- edits ----

async function draw(more = "") {
  keep();
  const { group, own } = room, asked = ++room.asked;
  const answer = await ask("draw", { edits: room.edits, ...about() });
  if (asked !== room.asked || answer.error || !here({ group, own })) return;
  $(".overlay").src = answer.overlay;
  const doubt = answer.still ? " Hardly anything changes there: is it the mirror or glass? The heat map (H) shows what changes." : "";
  say(`${(100 * answer.area).toFixed(1)} % of the photo, not saved yet.${doubt}${more}`);
  strip();
}

function edit(one) {
  if (!room.view) return;
  room.edits = [...room.edits, one];
  return draw();
}

function close(cut) {
  const points = room.corners;
  room.corners = [];
  sketch();
  if (points.length > 2) return edit({ tool: "polygon", points, target: !cut });
}

function press([x, y], shift) {
  if (room.tool === "hit" || room.tool === "miss") return edit({ tool: "click", x, y, target: (room.tool === "hit") !== shift });
  if (room.tool !== "polygon") return edit({ tool: "brush", points: [[x, y]], size: brush.value / 100, target: room.tool === "brush" });
  const [first] = room.corners, near = 12 / canvas.clientWidth;
  if (room.corners.length > 2 && Math.hypot(x - first[0], y - first[1]) < near) return close(shift);
  room.corners.push([x, y]);
  sketch();
}

async function save(version = room.version) {
  if (!room.view || room.saving) return;
  $(".conflict").hidden = true;
  const at = { group: room.group, own: room.own }, { edits } = room, place = stored();
  room.saving = true;
  const answer = await ask("save", { edits, version, ...about() });
  room.saving = false;
  if (!here(at)) {  // somebody looks at another mask by now
    if (answer.error) return say(`${at.group}: ${answer.error}`, true);
    sessionStorage.removeItem(place);
    say(`Saved: ${answer.saved}.`);
    return list();
  }
  if (answer.conflict) {
    $(".conflict").hidden = false;
    $(".conflict span").textContent = answer.error;
    $(".mine").onclick = () => save(answer.version);
    $(".theirs").onclick = async () => { $(".conflict").hidden = true; room.edits = []; keep(); await choose(room.own); };
    return say(answer.error, true);
  }
  if (answer.error) return;
  room.edits = room.edits.filter((one) => !edits.includes(one));  // what was drawn meanwhile is not saved
  room.version = answer.version;
  keep();
  say(`Saved: ${answer.saved}. Looking at the group again with it.`);
  await list();
  if (!here(at)) return;
  if (room.edits.length) return draw();
  if (await open(at.group, true)) say(`Saved: ${answer.saved}.`);
}

const actions = {
  propose: () => edit({ tool: "propose" }),
  clear: () => edit({ tool: "clear" }),
  undo: () => {
    if (room.corners.pop()) return sketch();
    if (!room.edits.length) return say("There is nothing to undo.");
    room.edits = room.edits.slice(0, -1);
    return draw();
  },
  save: () => save(),
};

function use(tool) {
  room.tool = tool;
  room.corners = [];
  canvas.style.touchAction = tool === "brush" || tool === "eraser" ? "none" : "pan-x pan-y pinch-zoom";
  return room.view && show();
}

let ticking;
function toggle(what) {
  room.shown[what] = !room.shown[what];
  clearInterval(ticking);
  if (room.shown.blink) ticking = setInterval(() => !room.own && step(1), 600);
  if (!room.view) return;
  strip();
  return show();
}

function step(by) {
  const names = room.view.photos.map((one) => one.name);
  const name = names.at((names.indexOf(room.photo) + by) % names.length);
  if (room.own) return choose(name);
  room.photo = name;
  for (const [index, button] of element.querySelectorAll(".strip button").entries()) button.setAttribute("aria-pressed", names[index] === name);
  return show();
}

// ---- pointer and keys ----

function sketch() {  // what is being drawn: corners, the stroke, the cross
  const { width, height } = canvas, thick = width / (canvas.clientWidth || width);
  pen.clearRect(0, 0, width, height);
  pen.lineJoin = pen.lineCap = "round";
  const line = (points, color, wide) => {
    pen.strokeStyle = color;
    pen.lineWidth = wide;
    pen.beginPath();
    for (const [x, y] of points) pen.lineTo(x * width, y * height);
    if (points.length === 1) pen.lineTo(points[0][0] * width + 0.1, points[0][1] * height);
    pen.stroke();
  };
  if (room.stroke) line(room.stroke, room.tool === "brush" ? "rgba(0,200,190,.6)" : "rgba(255,80,80,.6)", (brush.value / 100) * width);
  for (const [color, wide] of [["#000", 4], ["#fff", 2]]) {
    if (room.corners.length) line(room.corners, color, wide * thick);
    for (const corner of room.corners) line([corner], color, (wide + 4) * thick);
    if (!room.crossing) continue;
    const [x, y] = room.cross, reach = 12 * thick;
    line([[x - reach / width, y], [x + reach / width, y]], color, wide * thick);
    line([[x, y - reach / height], [x, y + reach / height]], color, wide * thick);
  }
}

function place(event) {
  const box = canvas.getBoundingClientRect(), share = (value) => Math.min(1, Math.max(0, value));
  return [share((event.clientX - box.left) / box.width), share((event.clientY - box.top) / box.height)];
}

let moved = 0;
canvas.addEventListener("pointerdown", (event) => {
  if (event.button !== 0) return;
  moved = 0;
  room.crossing = false;
  if (room.tool !== "brush" && room.tool !== "eraser") return;
  canvas.setPointerCapture(event.pointerId);
  room.stroke = [place(event)];
  sketch();
});
canvas.addEventListener("pointermove", (event) => {
  moved += Math.abs(event.movementX) + Math.abs(event.movementY);
  if (room.stroke) { room.stroke.push(place(event)); sketch(); }
});
canvas.addEventListener("pointerup", (event) => {
  if (event.button !== 0) return;
  const points = room.stroke;
  room.stroke = null;
  if (points) return edit({ tool: "brush", points, size: brush.value / 100, target: room.tool === "brush" });
  if (moved < 25) return press(place(event), event.shiftKey);
});
canvas.addEventListener("pointercancel", () => { room.stroke = null; sketch(); });
canvas.addEventListener("focus", () => { room.crossing = canvas.matches(":focus-visible"); sketch(); });
canvas.addEventListener("blur", () => { room.crossing = false; sketch(); });

const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const tools = { 1: "hit", 2: "miss", 3: "brush", 4: "eraser", 5: "polygon" };
const keys = {
  p: actions.propose, u: actions.undo, x: actions.clear, s: actions.save, h: () => toggle("heat"), m: () => toggle("mask"),
  b: () => toggle("blink"), n: () => step(1), r: () => step(-1),
  g: () => { const all = $(".group"); all.selectedIndex = (all.selectedIndex + 1) % all.length; return open(all.value); },
  "[": () => { brush.value = brush.value / 1.25; }, "]": () => { brush.value = brush.value * 1.25; },
  "+": () => { room.zoom = Math.min(8, room.zoom * 1.25); return show(); }, "-": () => { room.zoom = Math.max(1, room.zoom / 1.25); return show(); },
  Escape: () => { room.corners = []; sketch(); },
};
keys["="] = keys["+"];

element.addEventListener("keydown", (event) => {
  const typing = event.target.matches("select, input"), command = event.ctrlKey || event.metaKey;
  if (command && event.key === "z") { event.preventDefault(); return actions.undo(); }
  if (command && event.key === "s") { event.preventDefault(); return actions.save(); }
  if (typing || command || event.altKey || !room.view) return;
  if (event.target === canvas) {
    if (event.key in arrows) {
      event.preventDefault();
      const by = (event.shiftKey ? 20 : 2) / canvas.clientWidth, [x, y] = arrows[event.key], share = (value) => Math.min(1, Math.max(0, value));
      room.cross = [share(room.cross[0] + x * by), share(room.cross[1] + y * by * (canvas.width / canvas.height))];
      room.crossing = true;
      return sketch();
    }
    if (event.key === " ") { event.preventDefault(); return press(room.cross, event.shiftKey); }
    if (event.key === "Enter") { event.preventDefault(); return room.corners.length ? close(event.shiftKey) : press(room.cross, event.shiftKey); }
  } else if (event.key === "Enter" && room.corners.length && !event.target.matches("button")) return close(event.shiftKey);
  if (event.key in tools) return use(tools[event.key]);
  const action = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (action) { event.preventDefault(); return action(); }
});

for (const button of element.querySelectorAll("[data-tool]")) button.addEventListener("click", () => use(button.dataset.tool));
for (const button of element.querySelectorAll("[data-show]")) button.addEventListener("click", () => toggle(button.dataset.show));
for (const button of element.querySelectorAll("[data-do]")) button.addEventListener("click", () => actions[button.dataset.do]());
$(".group").addEventListener("change", () => open($(".group").value));
$(".for").addEventListener("change", () => choose($(".for").value));
use("hit");
new IntersectionObserver(async ([seen]) => {  // whenever the room is shown: there may be new groups
  if (!seen.isIntersecting) return;
  const before = room.group, name = await list();
  if (name && (name !== before || !room.view)) open(name);
}).observe(element);
