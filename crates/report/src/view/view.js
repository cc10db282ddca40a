// Filters and sorts the episodes, and plays their animations in step with the plots. The page reads without it.
(() => {
"use strict";
const all = (selector, within = document) => [...within.querySelectorAll(selector)];
const form = document.getElementById("filters"), list = document.getElementById("list");
const episodes = all(".ep"), keys = ["origin", "direction", "iteration", "outcome", "fate"];
const has = (e, key) => key === "fate" ? e.dataset.fates.split("|").filter(Boolean) : [e.dataset[key]];
const natural = (a, b) => String(a).localeCompare(String(b), "en", {numeric: true});

for (const key of keys) {
  const count = new Map();
  for (const e of episodes) for (const v of has(e, key)) if (v) count.set(v, (count.get(v) || 0) + 1);
  const select = form.elements[key];
  for (const [v, n] of [...count].sort((a, b) => natural(a[0], b[0]))) select.add(new Option(`${v} (${n})`, v));
  select.closest("label").hidden = count.size < 2 && key !== "fate" || count.size === 0;
}

function apply() {
  const f = form.elements, text = f.text.value.trim().toLowerCase();
  let shown = 0, frames = 0;
  for (const e of episodes) {
    e.hidden = !keys.every(k => !f[k].value || has(e, k).includes(f[k].value)) || !e.dataset.text.includes(text);
    if (!e.hidden) { shown++; frames += Number(e.dataset.rows); }
  }
  const by = f.sort.value, sign = f.down.checked ? -1 : 1;
  const missing = e => by !== "index" && e.dataset[by] === "" ? 1 : 0;
  list.append(...[...episodes].sort((a, b) => missing(a) - missing(b) || sign * natural(a.dataset[by], b.dataset[by])
    || a.dataset.index - b.dataset.index));
  f.count.textContent = `${shown} of ${episodes.length} episodes, ${frames} frames`;
  document.documentElement.dataset.shown = shown;
  const state = new URLSearchParams();
  for (const [k, v] of new FormData(form)) if (v && !(k === "sort" && v === "index")) state.set(k, v);
  const open = episodes.filter(e => e.open).map(e => e.dataset.index);
  if (open.length) state.set("open", open.join(" "));
  try { history.replaceState(null, "", "#" + state); } catch { /* some viewers have no history */ }
}

function restore() {
  for (const [k, v] of new URLSearchParams(location.hash.slice(1))) {
    if (k === "open") for (const e of episodes) e.open = v.split(" ").includes(e.dataset.index);
    const field = form.elements[k];
    if (field && field.type === "checkbox") field.checked = true; else if (field && "value" in field) field.value = v;
  }
  for (const s of all("select", form)) if (s.selectedIndex < 0) s.selectedIndex = 0;
}

// An animated PNG, taken apart into its pictures: each lies over those before it.
const crcs = Uint32Array.from({length: 256}, (_, n) => { for (let k = 0; k < 8; k++) n = n & 1 ? 0xedb88320 ^ n >>> 1 : n >>> 1; return n; });
function chunk(type, data) {
  const out = new Uint8Array(data.length + 12), view = new DataView(out.buffer);
  view.setUint32(0, data.length);
  for (let i = 0; i < 4; i++) out[4 + i] = type.charCodeAt(i);
  out.set(data, 8);
  let crc = ~0;
  for (let i = 4; i < data.length + 8; i++) crc = crcs[(crc ^ out[i]) & 255] ^ crc >>> 8;
  view.setUint32(data.length + 8, ~crc >>> 0);
  return out;
}
async function pictures(uri) {
  const bytes = Uint8Array.from(atob(uri.slice(uri.indexOf(",") + 1)), c => c.charCodeAt(0));
  const view = new DataView(bytes.buffer), parts = [];
  let head;
  for (let at = 8; at + 12 <= bytes.length;) {
    const size = view.getUint32(at), type = String.fromCharCode(...bytes.subarray(at + 4, at + 8));
    const data = bytes.subarray(at + 8, at + 8 + size);
    if (type === "IHDR") head = data;
    if (type === "fcTL") parts.push({w: view.getUint32(at + 12), h: view.getUint32(at + 16), x: view.getUint32(at + 20), y: view.getUint32(at + 24), data: []});
    if (type === "IDAT" && parts.length) parts[parts.length - 1].data.push(chunk("IDAT", data));
    if (type === "fdAT") parts[parts.length - 1].data.push(chunk("IDAT", data.subarray(4)));
    at += size + 12;
  }
  return Promise.all(parts.map(async p => {
    const h = Uint8Array.from(head), v = new DataView(h.buffer);
    v.setUint32(0, p.w); v.setUint32(4, p.h);
    const file = new Blob([bytes.subarray(0, 8), chunk("IHDR", h), ...p.data, chunk("IEND", new Uint8Array())], {type: "image/png"});
    return {x: p.x, y: p.y, bitmap: await createImageBitmap(file)};
  }));
}

async function start(e) {
  if (e.dataset.started) return;
  e.dataset.started = "yes";
  const count = Number(e.dataset.rows), hz = Number(e.dataset.hz) || 20, film = e.querySelector(".film");
  const plots = all(".plot", e).map(p => {
    const now = document.createElement("div");
    now.className = "now";
    const area = p.querySelector(".area");
    area.append(now);
    return {area, now, rows: Number(p.dataset.rows), map: p.dataset.map ? p.dataset.map.split(" ").map(Number) : null};
  });
  let row = 0, draw = () => {}, pause = () => {};
  const seek = r => {
    row = Math.max(0, Math.min(count - 1, Math.round(r)));
    for (const p of plots) p.now.style.left = 100 * ((p.map ? p.map[row] : row) + .5) / Math.max(1, p.rows) + "%";
    draw(row);
  };
  for (const p of plots) {
    const to = event => {
      if (event.type === "pointermove" && event.pointerType !== "mouse" && !event.buttons) return;
      const box = p.area.getBoundingClientRect(), at = (event.clientX - box.left) / box.width * p.rows - .5;
      pause();
      seek(p.map ? p.map.reduce((best, t, i) => Math.abs(t - at) < Math.abs(p.map[best] - at) ? i : best, 0) : at);
    };
    p.area.addEventListener("pointerdown", to);
    p.area.addEventListener("pointermove", to);
  }
  if (film) {
    const img = film.querySelector("img"), rows = film.dataset.rows.split(" ").map(Number);
    const frames = await pictures(img.src);
    const canvas = document.createElement("canvas"), context = canvas.getContext("2d");
    canvas.width = img.getAttribute("width"); canvas.height = img.getAttribute("height");
    canvas.setAttribute("role", "img"); canvas.setAttribute("aria-label", img.alt);
    const bar = document.createElement("div"), button = document.createElement("button");
    const range = document.createElement("input"), time = document.createElement("time");
    bar.className = "bar"; button.type = "button"; range.type = "range"; range.max = count - 1;
    range.setAttribute("aria-label", "frame");
    bar.append(button, range, time);
    img.replaceWith(canvas); canvas.after(bar);
    let at = -1, timer = 0;
    draw = r => {
      let k = rows.length - 1;
      while (k > 0 && rows[k] > r) k--;
      for (let i = k < at ? 0 : at + 1; i <= k; i++) context.drawImage(frames[i].bitmap, frames[i].x, frames[i].y);
      at = k;
      range.value = r;
      time.textContent = `${(r / hz).toFixed(1)} s, row ${r}`;
    };
    pause = () => { clearInterval(timer); timer = 0; button.textContent = "play"; };
    const play = () => {
      pause();
      button.textContent = "pause";
      if (row >= count - 1) seek(0);
      const from = row, begun = performance.now();
      timer = setInterval(() => {
        const r = from + Math.floor((performance.now() - begun) / 1000 * hz);
        if (!e.open || r >= count - 1) { seek(Math.min(r, count - 1)); pause(); } else seek(r);
      }, 1000 / Math.min(hz, 30));
    };
    button.addEventListener("click", () => timer ? pause() : play());
    range.addEventListener("input", () => { pause(); seek(Number(range.value)); });
    seek(0);
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) pause(); else play();
  } else seek(0);
  e.dataset.started = "done";
}

for (const e of episodes) e.addEventListener("toggle", () => { if (e.open) start(e); apply(); });
form.hidden = false;
form.addEventListener("input", apply);
form.addEventListener("reset", () => setTimeout(apply));
form.addEventListener("submit", event => event.preventDefault());
restore();
apply();
for (const e of episodes) if (e.open) start(e);
addEventListener("hashchange", () => { restore(); apply(); });
})();
