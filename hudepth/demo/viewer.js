// The viewer of one result. gr.HTML calls this with the element, its props and a way to watch them.
const find = (selector) => element.querySelector(selector);
const stage = find(".hd-stage"), cloud = find(".hd-cloud"), photo = find(".hd-photo"), slider = find(".hd-slider input");
const reading = find(".hd-reading"), dot = find(".hd-dot"), fixed = find(".hd-fixed input");
const HEIGHT_VH = 64; // maximum height of the picture, in percent of the window
const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const colours = bytesOf(props.colours); // 256 x RGB, near first
let shown = null, mode = "map", points, at = null, marks = [];

function show(value) {
  const result = value && value.depth_mm ? value : null;
  find(".hd-message").hidden = !(value && value.error);
  find(".hd-message").textContent = (value && value.error) || "";
  find(".hd-empty").hidden = !!result;
  find(".hd-result").hidden = !result;
  shown = null;
  hideReading();
  if (result) showResult(result);
  if (value && element.getBoundingClientRect().top > 0.5 * window.innerHeight) {
    element.scrollIntoView({ block: "start" }); // on a phone it is below the examples
  }
}

function showResult(result) {
  shown = { ...result, depth: new Uint16Array(bytesOf(result.depth_mm).buffer), edges: bytesOf(result.edges) };
  photo.src = result.photo;
  find(".hd-caption").replaceChildren(
    ...result.facts.map((fact) => Object.assign(document.createElement("li"), { textContent: fact })),
  );
  find(".hd-fixed span").textContent = `same colours for all pictures, 0 to ${+result.max_depth_m.toFixed(1)} m`;
  measure([]);
  stage.style.aspectRatio = cloud.style.aspectRatio = `${result.width} / ${result.height}`;
  find(".hd-viewer").style.setProperty("--hd-high", `${(HEIGHT_VH * result.width) / result.height}vh`);
  preview(result.photo);
  if (points) points.stale = true;
  paint();
  setMode(mode);
}

// Of a picture that the browser cannot show, as a HEIC, shows the decoded one.
function preview(decoded) {
  const chosen = document.querySelector("#picture img");
  if (!chosen) return;
  if (chosen.complete && !chosen.naturalWidth) chosen.src = decoded;
  else if (!chosen.complete) chosen.addEventListener("error", () => (chosen.src = decoded), { once: true });
}

// The ends of the colour scale [m].
const scale = () => (fixed.checked ? [0, shown.max_depth_m] : shown.scale_m);

function paint() {
  const { width, height, depth } = shown, [near, far] = scale();
  const canvas = Object.assign(find(".hd-depth"), { width, height });
  const picture = new ImageData(width, height);
  for (let i = 0; i < depth.length; i++) {
    const step = Math.round((255 * (depth[i] / 1000 - near)) / (far - near));
    const from = 3 * Math.max(0, Math.min(255, step));
    for (let c = 0; c < 3; c++) picture.data[4 * i + c] = depth[i] ? colours[from + c] : 191;
    picture.data[4 * i + 3] = 255;
  }
  canvas.getContext("2d").putImageData(picture, 0, 0);
  legend(near, far);
}

function legend(near, far) {
  const bar = find(".hd-scale canvas"), strip = new ImageData(1, 256);
  for (let i = 0; i < 256; i++) strip.data.set([colours[3 * i], colours[3 * i + 1], colours[3 * i + 2], 255], 4 * i);
  bar.getContext("2d").putImageData(strip, 0, 0);
  const ticks = [0, 1, 2, 3, 4, 5].map((i) => {
    const tick = document.createElement("span");
    tick.style.top = `${20 * i}%`;
    tick.textContent = `${(near + (i / 5) * (far - near)).toFixed(far - near < 5 ? 2 : 1)} m`;
    return tick;
  });
  find(".hd-ticks").replaceChildren(...ticks);
  find(".hd-scale").setAttribute("aria-label", `Colour scale from ${near.toFixed(2)} to ${far.toFixed(2)} metres`);
}

function split() {
  const share = Number(slider.value);
  photo.style.clipPath = `inset(0 ${100 - share}% 0 0)`;
  find(".hd-line").style.left = `${share}%`;
}

// x and y: fractions of the width and height, from 0 to 1.
function read(x, y) {
  if (!shown) return;
  const inside = (value) => Math.max(0, Math.min(0.999999, value));
  at = { x: inside(x), y: inside(y) };
  const column = Math.floor(at.x * shown.width), row = Math.floor(at.y * shown.height);
  const mm = shown.depth[row * shown.width + column];
  reading.textContent = mm ? `${(mm / 1000).toFixed(2)} m` : "no depth";
  reading.dataset.mm = mm;
  Object.assign(dot.style, { left: `${100 * at.x}%`, top: `${100 * at.y}%` });
  reading.hidden = dot.hidden = false;
  place(reading, at.x, at.y);
}

// Lays a reading next to a point, inside the picture.
function place(label, x, y) {
  const room = stage.getBoundingClientRect();
  const left = x * room.width + 14, top = y * room.height - label.offsetHeight - 10;
  label.style.left = `${left + label.offsetWidth > room.width ? Math.max(0, left - label.offsetWidth - 28) : left}px`;
  label.style.top = `${top < 2 ? y * room.height + 14 : top}px`;
}

// The point in space [m] that lies at fractions of the picture's width and height; null without depth.
function lift({ x, y }) {
  const column = Math.floor(x * shown.width), row = Math.floor(y * shown.height), [fx, fy, cx, cy] = shown.camera;
  const z = shown.depth[row * shown.width + column] / 1000;
  return z ? [((column - cx) * z) / fx, ((row - cy) * z) / fy, z] : null;
}

// Marks at most two points, and states how far apart they are.
function measure(next) {
  marks = next;
  const apart = find(".hd-apart"), span = find(".hd-span"), spots = element.querySelectorAll(".hd-mark");
  spots.forEach((spot, i) => {
    spot.hidden = !marks[i];
    if (marks[i]) Object.assign(spot.style, { left: `${100 * marks[i].x}%`, top: `${100 * marks[i].y}%` });
  });
  const both = marks.length === 2;
  apart.hidden = !both;
  span.toggleAttribute("hidden", !both);
  const hints = ["Click two points to measure how far apart they are.", "Click the other point."];
  if (!both) return void (find(".hd-measure").textContent = hints[marks.length]);
  const [a, b] = marks, [p, q] = marks.map(lift);
  for (const line of span.children) {
    for (const [name, value] of [["x1", a.x], ["y1", a.y], ["x2", b.x], ["y2", b.y]]) line.setAttribute(name, 100 * value);
  }
  const metres = Math.hypot(...p.map((value, i) => value - q[i])).toFixed(2);
  apart.textContent = `${metres} m`;
  place(apart, (a.x + b.x) / 2, (a.y + b.y) / 2);
  find(".hd-measure").textContent = `The two points are ${metres} m apart. Click another to begin anew.`;
}

function mark() {
  if (at && lift(at)) measure(marks.length === 2 ? [at] : [...marks, at]);
}

function hideReading() {
  reading.hidden = dot.hidden = true;
  at = null;
}

function setMode(next) {
  mode = next;
  const inSpace = mode === "cloud";
  for (const button of element.querySelectorAll(".hd-modes button")) {
    button.setAttribute("aria-pressed", String(button.dataset.mode === mode));
  }
  for (const name of [".hd-stage", ".hd-slider", ".hd-scale", ".hd-fixed", ".hd-measure"]) find(name).hidden = inSpace;
  cloud.hidden = find(".hd-hint").hidden = !inSpace;
  if (inSpace && shown) showPoints();
}

async function showPoints() {
  points = points || pointsView(cloud) || { missing: true };
  if (points.missing) {
    find(".hd-hint").textContent = "This browser has no WebGL, so it cannot show the points. The PLY file contains them.";
    return;
  }
  if (points.stale === false) return points.draw();
  await photo.decode();
  const { width, height } = shown;
  const pen = Object.assign(document.createElement("canvas"), { width, height }).getContext("2d");
  pen.drawImage(photo, 0, 0, width, height);
  points.show({ ...shown, rgba: pen.getImageData(0, 0, width, height).data });
  points.stale = false;
}

let dragging = false, dragged = false;
const shares = (event) => {
  const room = stage.getBoundingClientRect();
  return [(event.clientX - room.left) / room.width, (event.clientY - room.top) / room.height, room.width];
};
const slide = (share) => {
  slider.value = String(Math.round(100 * share));
  split();
};
const nearLine = (event) => {
  const [x, , width] = shares(event);
  return Math.abs(x - slider.value / 100) * width < (event.pointerType === "mouse" ? 8 : 22);
};
stage.addEventListener("pointerdown", (event) => {
  dragging = dragged = nearLine(event);
  if (dragging) stage.setPointerCapture(event.pointerId);
  else read(...shares(event));
});
stage.addEventListener("pointermove", (event) => {
  if (dragging) slide(shares(event)[0]);
  else if (event.pointerType === "mouse") read(...shares(event));
  stage.classList.toggle("hd-dragging", dragging || nearLine(event));
});
for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, () => (dragging = false));
stage.addEventListener("pointerleave", (event) => event.pointerType === "mouse" && hideReading());
stage.addEventListener("click", (event) => {
  if (dragged || !shown) return;
  read(...shares(event));
  mark();
});
stage.addEventListener("keydown", (event) => {
  if (event.key === "Enter") mark();
  if (event.key === "Escape") measure([]);
  const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  if (!step) return;
  event.preventDefault();
  const from = at || { x: 0.5, y: 0.5 };
  read(from.x + step[0] / 50, from.y + step[1] / 50);
});
slider.addEventListener("input", split);
fixed.addEventListener("change", () => shown && paint());
for (const button of element.querySelectorAll(".hd-modes button")) {
  button.addEventListener("click", () => setMode(button.dataset.mode));
}
// gradio gives the examples no alternative text.
function nameExamples(tries) {
  const pictures = document.querySelectorAll("#rooms img");
  for (const each of pictures) each.alt = `Example: ${each.src.split("/").pop().split(".")[0].replace("_", " ")}`;
  if (!pictures.length && tries) setTimeout(() => nameExamples(tries - 1), 100);
}
// A picture pasted anywhere on the page is treated like a chosen file.
document.addEventListener("paste", (event) => {
  const input = document.querySelector("#picture input[type=file]");
  const file = Array.from(event.clipboardData.files).find((each) => each.type.startsWith("image/"));
  if (!input || !file) return;
  const chosen = new DataTransfer();
  chosen.items.add(file);
  input.files = chosen.files;
  input.dispatchEvent(new Event("change", { bubbles: true }));
});

nameExamples(50);
split();
watch("value", () => show(props.value));
show(props.value);
