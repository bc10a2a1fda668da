"""Style and script of a report's page; both go into the page itself, which names no other file."""

STYLE = """
:root {
  color-scheme: light dark;
  --paper: #fbfaf8; --card: #ffffff; --ink: #1b1d22; --soft: #5d6370; --line: #e3e1dc; --tint: #f3f1ec;
  --accent: #0b63a5; --better: #0068a8; --worse: #b34700; --better-tint: #e4f0f8; --worse-tint: #fbeae0;
}
@media (prefers-color-scheme: dark) {
  :root {
    --paper: #14161a; --card: #1b1e24; --ink: #e8e6e1; --soft: #a0a5b0; --line: #31353d; --tint: #23272e;
    --accent: #7cc0f2; --better: #7cc0f2; --worse: #f5a06a; --better-tint: #17303f; --worse-tint: #3d2819;
  }
}
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, "Segoe UI", Roboto, sans-serif; }
main, header, footer { max-width: 84rem; margin: 0 auto; padding: 0 clamp(1rem, 3vw, 2.5rem); }
header { padding-top: clamp(1.5rem, 5vw, 3.5rem); }
h1, h2 { font-family: Georgia, "Times New Roman", "DejaVu Serif", serif; font-weight: 600; line-height: 1.2; }
h1 { font-size: clamp(1.6rem, 4.5vw, 2.5rem); margin: 0 0 .5rem; overflow-wrap: anywhere; }
h2 { font-size: 1.4rem; margin: 3rem 0 .6rem; padding-top: 1rem; border-top: 1px solid var(--line); }
p { max-width: 68ch; margin: .5rem 0 1rem; }
.lead { font-size: 1.1rem; color: var(--soft); }
.quiet, figcaption { color: var(--soft); font-size: .9rem; }
a { color: var(--accent); }
nav { display: flex; flex-wrap: wrap; gap: .3rem 1.2rem; font-size: .92rem; margin: 1rem 0 0; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr)); gap: 1rem 1.5rem;
  margin: 1.5rem 0; }
.facts dt { font-size: .74rem; letter-spacing: .07em; text-transform: uppercase; color: var(--soft); }
.facts dd { margin: .1rem 0 0; overflow-wrap: anywhere; }
.notice { background: var(--worse-tint); border-left: 4px solid var(--worse); border-radius: 4px;
  padding: .6rem 1rem; }
.notice ul, ul.plain { margin: 0; padding-left: 1.1rem; }
ul.plain li { overflow-wrap: anywhere; }
.tools { display: flex; flex-wrap: wrap; align-items: center; gap: .6rem 1rem; margin: .8rem 0; }
.tools input { font: inherit; color: inherit; background: var(--card); border: 1px solid var(--soft);
  border-radius: 6px;
  padding: .4rem .7rem; width: min(22rem, 100%); }
:focus-visible { outline: 3px solid var(--accent); outline-offset: 2px; }
.scroll { overflow: auto; max-height: 85vh; background: var(--card); border: 1px solid var(--line);
  border-radius: 8px; }
table { border-collapse: separate; border-spacing: 0; width: 100%; font-size: .9rem; }
th, td { padding: .45rem .75rem; text-align: right; vertical-align: top; border-bottom: 1px solid var(--line);
  white-space: nowrap; font-variant-numeric: tabular-nums; }
tbody tr:last-child > * { border-bottom: 0; }
tbody tr:hover > * { background: var(--tint); }
th.text, td.text, th[scope=row] { text-align: left; }
td.long { white-space: normal; min-width: 18rem; overflow-wrap: anywhere; }
thead th { position: sticky; top: 0; z-index: 2; background: var(--tint); padding: 0; font-weight: 600; }
thead th.flat { padding: .5rem .75rem; }
thead button { all: unset; box-sizing: border-box; width: 100%; padding: .5rem .75rem; cursor: pointer;
  white-space: nowrap; }
thead button:focus-visible { outline: 3px solid var(--accent); outline-offset: -3px; }
thead button::after { content: "\\2195"; display: inline-block; width: 1em; text-align: right; opacity: .35; }
thead th[aria-sort=ascending] button::after { content: "\\25B2"; opacity: 1; }
thead th[aria-sort=descending] button::after { content: "\\25BC"; opacity: 1; }
th[scope=row], thead th:first-child { position: sticky; left: 0; z-index: 1; background: var(--card);
  font-weight: 600;
  white-space: normal; min-width: 9.5rem; max-width: min(20rem, 42vw); overflow-wrap: anywhere; }
thead th:first-child { z-index: 3; background: var(--tint); }
td small, th small { display: block; color: var(--soft); font-size: .76rem; font-weight: 400; line-height: 1.4; }
.best { font-weight: 700; }
.best .value { border-bottom: 2px solid var(--accent); }
.tag { display: inline-block; font-size: .7rem; font-weight: 600; padding: 0 .4rem; border-radius: 4px;
  background: var(--tint);
  color: var(--soft); vertical-align: middle; }
td.better { background: var(--better-tint); } td.better .value, td.better .word { color: var(--better);
  font-weight: 600; }
td.worse { background: var(--worse-tint); } td.worse .value, td.worse .word { color: var(--worse); font-weight: 600; }
.caution { color: var(--worse); }
figure { margin: 1.5rem 0; }
figure img { display: block; max-width: 100%; height: auto; background: #fff; border: 1px solid var(--line);
  border-radius: 8px;
  padding: .5rem; }
figcaption { margin-top: .5rem; max-width: 80ch; }
details { border: 1px solid var(--line); border-radius: 8px; background: var(--card); margin: .5rem 0; }
summary { cursor: pointer; padding: .5rem .9rem; overflow-wrap: anywhere; }
details .scroll { border: 0; border-top: 1px solid var(--line); border-radius: 0 0 8px 8px; }
code { font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: .88em; overflow-wrap: anywhere; }
footer { padding-top: 2rem; padding-bottom: 3rem; }
[hidden] { display: none !important; }
@media (max-width: 40rem) { body { font-size: 15px; } .scroll { max-height: none; } .wide { overflow-x: auto; }
  .wide img { max-width: none; width: 54rem; } }
@media print { .tools, nav { display: none; } .scroll { max-height: none; overflow: visible; border: 0; } }
"""

SCRIPT = """
"use strict";
const text = new Intl.Collator(undefined, { numeric: true, sensitivity: "base" });

function valueOf(row, column) {
  const cell = row.cells[column];
  return cell.hasAttribute("data-value") ? cell.getAttribute("data-value") : cell.textContent.trim();
}

function sort(table, head, descending) {
  const column = head.cellIndex;
  const numbers = head.dataset.kind === "number";
  const rows = Array.from(table.tBodies[0].rows, (row, place) => {
    const value = valueOf(row, column);
    return { row, place, value: numbers ? (value === "" ? NaN : Number(value)) : value };
  });
  const missing = (value) => (numbers ? Number.isNaN(value) : value === "" || value === "-");
  rows.sort((a, b) => {
    if (missing(a.value) || missing(b.value)) {
      return missing(a.value) - missing(b.value) || a.place - b.place; // what is missing stays last either way
    }
    const order = numbers ? a.value - b.value : text.compare(a.value, b.value);
    return (descending ? -order : order) || a.place - b.place;
  });
  for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", descending ? "descending" : "ascending");
  table.tBodies[0].append(...rows.map((each) => each.row));
}

for (const table of document.querySelectorAll("table.sortable")) {
  for (const head of table.tHead.rows[0].cells) {
    head.querySelector("button").addEventListener("click", () => {
      sort(table, head, head.getAttribute("aria-sort") === "ascending");
    });
  }
}

const box = document.getElementById("filter");
const said = document.getElementById("filtered");
if (box) {
  box.addEventListener("input", () => {
    const words = box.value.toLowerCase().split(/\\s+/).filter(Boolean);
    for (const row of document.querySelectorAll("[data-filter]")) {
      row.hidden = !words.every((word) => row.dataset.filter.includes(word));
    }
    const rows = Array.from(document.querySelectorAll("#results [data-filter]"));
    said.textContent = `${rows.filter((row) => !row.hidden).length} of ${rows.length} rows`;
  });
}
"""
