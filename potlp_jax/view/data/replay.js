"use strict";
// Shows one recorded trial: the map as it was known at every step, and what was weighed at the decision in force.
// `data` is what view/replay_page.py writes. Steps and decisions count from 0, as in the record.

const MARK_PIXELS = 7;
// Of its own width that the map keeps on a narrow screen.
const LEAST_SHARE = 0.75;
// Chances of the legend of what is imagined.
const CHANCES = [0, 0.05, 0.1, 0.25, 0.5, 1];
// Of one chance alone: from pale to dark, so that lightness alone tells, on light and dark screens.
const RAMP = ["#E3EAF3", "#5F93C8", "#08244F"];

function mountReplay(root, data) {
  const seen = decodeIntegers(data.first_seen);
  const occupied = Uint8Array.from(atob(data.occupied), (letter) => letter.charCodeAt(0));
  const [rows, columns] = data.extent;
  const scale = data.cell_pixels;
  const lane = keepRight(data.path, 0.24);
  const last = data.path.length - 1;
  const choices = overlayChoices(), pictures = new Map();
  // Several decisions may be taken at one step, where the robot failed to move: each is a place of its own.
  let step = 0, number = firstDecision(), choice = choices[0];

  root.classList.add("replay");
  root.innerHTML = `
    <p class="facts"></p>
    <div class="scroll"><canvas class="map" role="img"></canvas></div>
    <div class="controls">
      <button type="button" data-go="decision-back" title="Page Up">◀ decision</button>
      <button type="button" data-go="step-back" title="Left arrow" aria-label="one step back">◁</button>
      <input type="range" min="0" max="${last}" value="0" aria-label="step of the trial">
      <button type="button" data-go="step-on" title="Right arrow" aria-label="one step on">▷</button>
      <button type="button" data-go="decision-on" title="Page Down">decision ▶</button>
      <span class="where" aria-live="polite"></span>
    </div>
    <div class="overlay" hidden>
      <label>Map shows <select></select></label>
      <ul class="legend scale"></ul>
      <p class="reading" aria-live="polite"></p>
    </div>
    <ul class="legend names"></ul>
    <h2 class="decision"></h2>
    <p class="note"></p>
    <div class="scroll"><table class="actions"></table></div>
    <details class="key"><summary>What the columns mean</summary><dl></dl></details>
    <div class="views"></div>`;
  const part = (name) => root.querySelector(name);
  const canvas = part("canvas"), slider = part("input");
  canvas.width = columns * scale;
  canvas.height = rows * scale;
  // On a narrower screen it scrolls: its letters are of canvas pixels, and would be too small to read.
  canvas.style.minWidth = `${LEAST_SHARE * canvas.width}px`;
  part(".facts").textContent = data.facts;
  part(".names").append(...legend());
  part(".overlay").hidden = choices.length < 2;
  part("select").append(...choices.map(({ name }) => new Option(name)));
  for (const [name, meaning] of Object.entries(data.figures)) {
    const term = document.createElement("dt"), text = document.createElement("dd");
    term.textContent = name;
    text.textContent = meaning;
    part(".key dl").append(term, text);
  }

  // Areas as squares, states as strokes: as they look on the map.
  function legend() {
    const entries = data.propositions.map((name, bit) => [name, data.area_colours[bit], "area"]);
    for (const state of new Set([...data.states].sort((a, b) => a - b))) entries.push([data.state_names[state], data.state_colours[state], "state"]);
    return entries.map(([name, colour, kind]) => legendItem(name, colour, kind));
  }

  function legendItem(name, colour, kind) {
    const item = document.createElement("li"), mark = document.createElement("i");
    mark.className = kind;
    mark.style.background = colour;
    item.append(mark, name);
    return item;
  }

  // What the map can show: what is known, what the estimator painted, all that it imagines, or one of these chances.
  function overlayChoices() {
    const found = [{ name: "what is known" }];
    data.overlays.forEach((overlay, number) => {
      found.push({ name: overlay.name, overlay, number });
      if (overlay.kind !== "imagined") return;
      ["free space", ...data.propositions].forEach((name, entry) => found.push({ name: `${overlay.name}: ${name}`, overlay, number, entry }));
    });
    return found;
  }

  function packed(decision) {
    return decision && choice.overlay ? data.overlays_at[decision.index]?.[choice.number] : undefined;
  }

  // The chance of each entry (free, then the propositions) in each square.
  function chancesOf(text) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)), entries = data.propositions.length + 1;
    return (row, column, entry) => bytes[(row * choice.overlay.columns + column) * entries + entry] / 255;
  }

  // Images in a page are decoded in their own time; once that is done the map is drawn again.
  function picture(source) {
    if (!pictures.has(source)) {
      const image = new Image();
      image.onload = show;
      image.src = source;
      pictures.set(source, image);
    }
    return pictures.get(source);
  }

  // What a robot took a cell for and took back later; none in simulation.
  function correctionsNow() {
    const now = data.corrections.filter(([, from, until]) => from <= step && step < until);
    return new Map(now.map(([index, , , value, letter]) => [index, { value, letter }]));
  }

  function isKnown(row, column) {
    const first = seen[row * data.width + column];
    return first >= 0 && first <= step;
  }

  function strength(chance) {
    return chance < data.least_chance ? 0 : Math.sqrt(chance);
  }

  function drawOverlay(context, decision) {
    const source = packed(decision);
    if (source === undefined) return;
    if (choice.overlay.kind === "painted") {
      const image = picture(source);
      context.imageSmoothingEnabled = false;
      if (image.complete && image.naturalWidth) context.drawImage(image, 0, 0, columns * scale, rows * scale);
    } else {
      drawImagined(context, chancesOf(source));
    }
    drawRim(context);
  }

  function drawImagined(context, chance) {
    const side = choice.overlay.side;
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        if (isKnown(row, column)) continue;
        const of = (entry) => chance(Math.floor(row / side), Math.floor(column / side), entry);
        const free = of(0), place = row + column;
        const likely = data.propositions.map((_, bit) => bit).filter((bit) => strength(of(bit + 1)) > 0).sort((a, b) => of(b + 1) - of(a + 1));
        if (choice.entry !== undefined) {
          context.fillStyle = ramp(of(choice.entry), choice.entry);
        } else {
          const below = mixed(data.imagined_colours[0], data.imagined_colours[1], free), bit = likely[place % likely.length];
          // Cells along a diagonal take turns, so that several propositions of one square show beside each other.
          context.fillStyle = likely.length ? mixed(below, data.area_colours[bit], strength(of(bit + 1))) : below;
        }
        context.fillRect(column * scale, row * scale, scale, scale);
      }
    }
  }

  // Free space is likely or not, and a proposition rare: the former's chance is shown as it is.
  function ramp(chance, entry) {
    const along = 2 * (entry === 0 ? chance : strength(chance));
    return along < 1 ? mixed(RAMP[0], RAMP[1], along) : mixed(RAMP[1], RAMP[2], along - 1);
  }

  // A line between what is known and what is not: an overlay may have the colours of either.
  function drawRim(context) {
    context.beginPath();
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        if (column + 1 < columns && isKnown(row, column) !== isKnown(row, column + 1)) {
          context.moveTo((column + 1) * scale, row * scale);
          context.lineTo((column + 1) * scale, (row + 1) * scale);
        }
        if (row + 1 < rows && isKnown(row, column) !== isKnown(row + 1, column)) {
          context.moveTo(column * scale, (row + 1) * scale);
          context.lineTo((column + 1) * scale, (row + 1) * scale);
        }
      }
    }
    context.strokeStyle = "#222222";
    context.lineWidth = 1;
    context.stroke();
  }

  function showScale() {
    const items = [], { overlay, entry } = choice;
    if (overlay?.kind === "painted") items.push("Colours as the camera saw them; within the line the map is known.");
    if (overlay?.kind === "imagined" && entry === undefined) {
      items.push(legendItem("free", data.imagined_colours[1], "area"), legendItem("obstacle", data.imagined_colours[0], "area"));
      items.push("A proposition's colour is the stronger the more likely it holds there:");
      for (const chance of CHANCES.slice(1)) items.push(legendItem(percent(chance), mixed(data.imagined_colours[1], data.area_colours[0], strength(chance)), "area"));
    }
    if (entry !== undefined) for (const chance of CHANCES) items.push(legendItem(percent(chance), ramp(chance, entry), "area"));
    part(".scale").replaceChildren(...items.map((item) => {
      if (typeof item !== "string") return item;
      const text = document.createElement("li");
      text.textContent = item;
      return text;
    }));
  }

  // In words too: where each proposition is most likely, of the squares with a cell that is not known.
  function showReading(decision, at) {
    const source = packed(decision);
    if (source === undefined || choice.overlay.kind !== "imagined") {
      part(".reading").textContent = choice.overlay && source === undefined ? "Nothing is painted or imagined before the first decision." : "";
      return;
    }
    const chance = chancesOf(source), side = choice.overlay.side;
    if (at) {
      const square = at.map((number) => Math.floor(number / side));
      const all = ["free", ...data.propositions].map((name, entry) => `${name} ${percent(chance(...square, entry))}`);
      part(".reading").textContent = isKnown(...at) ? `Row ${at[0]}, column ${at[1]} is known.` : `Row ${at[0]}, column ${at[1]}: ${all.join(", ")}`;
      return;
    }
    const best = data.propositions.map(() => [0, null]);
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        if (isKnown(row, column)) continue;
        best.forEach((found, bit) => {
          const here = chance(Math.floor(row / side), Math.floor(column / side), bit + 1);
          if (here > found[0]) best[bit] = [here, [row, column]];
        });
      }
    }
    const told = best.map(([most, cell], bit) => (cell ? `${data.propositions[bit]} ${percent(most)} near row ${cell[0]}, column ${cell[1]}` : null));
    part(".reading").textContent = `Most likely where nothing was observed: ${told.filter((text) => text).join("; ") || "nothing"}`;
  }

  function colour(name) {
    return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  }

  function line(context, cells, style, width, dash = []) {
    context.beginPath();
    for (const [row, column] of cells) context.lineTo((column + 0.5) * scale, (row + 0.5) * scale);
    context.strokeStyle = style;
    context.lineWidth = width;
    context.setLineDash(dash);
    context.lineJoin = context.lineCap = "round";
    context.stroke();
    context.setLineDash([]);
  }

  function drawCells(context) {
    const paint = { free: colour("--free"), wall: colour("--wall"), unseen: colour("--unseen"), unseenWall: colour("--unseen-wall") };
    const corrected = correctionsNow();
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        const index = row * data.width + column;
        const entry = corrected.get(index);
        const known = entry ? entry.value >= 0 : isKnown(row, column);
        const wall = entry && known ? entry.value === 1 : occupied[index];
        context.fillStyle = wall ? (known ? paint.wall : paint.unseenWall) : known ? paint.free : paint.unseen;
        context.fillRect(column * scale, row * scale, scale, scale);
      }
    }
    const asSeen = data.letters.filter(([row, column]) => !corrected.has(row * data.width + column));
    const seenOtherwise = [...corrected].map(([index, { letter }]) => [
      Math.floor(index / data.width),
      index % data.width,
      letter,
    ]);
    for (const [row, column, letter] of [...asSeen, ...seenOtherwise]) {
      const known = corrected.has(row * data.width + column) || isKnown(row, column);
      const bits = data.propositions.map((_, bit) => bit).filter((bit) => (letter >> bit) & 1);
      bits.forEach((bit, place) => {
        context.globalAlpha = known ? 1 : 0.35;
        context.fillStyle = data.area_colours[bit];
        context.fillRect(column * scale + (place * scale) / bits.length, row * scale, scale / bits.length, scale);
      });
      context.globalAlpha = 1;
    }
  }

  function drawPath(context) {
    for (let first = 0; first < step; ) {
      let end = first + 1;
      while (end < step && data.states[end] === data.states[first]) end++;
      line(context, lane.slice(first, end + 1), data.state_colours[data.states[first]], Math.max(2, scale / 2.5));
      first = end;
    }
  }

  function drawPlan(context, decision) {
    if (!decision) return;
    line(context, decision.path, colour("--planned"), Math.max(1, scale / 5), [scale, scale]);
    decision.subgoals.forEach((cell) => drawMark(context, cell, false));
    // The target need be none of the subgoals: finishing in known space has one too.
    if (decision.target) drawMark(context, decision.target, true);
    decision.subgoals.forEach((cell, number) => {
      const mine = isTarget(decision, cell);
      const [x, y] = [(cell[1] + 0.5) * scale, (cell[0] + 0.5) * scale];
      // Toward the middle, so that no number leaves the map.
      const inward = [x < canvas.width / 2 ? 1 : -1, y < canvas.height / 2 ? 1 : -1];
      write(context, `s${number}`, x + 15 * inward[0], y + 12 * inward[1], mine ? "--chosen" : "--ink", 700);
    });
  }

  function isTarget(decision, cell) {
    return decision.target !== null && decision.target[0] === cell[0] && decision.target[1] === cell[1];
  }

  // A triangle at a subgoal: open, or filled where the robot goes.
  function drawMark(context, cell, filled) {
    const [x, y] = [(cell[1] + 0.5) * scale, (cell[0] + 0.5) * scale];
    context.beginPath();
    for (const corner of [-90, 30, 150]) {
      const angle = (corner * Math.PI) / 180;
      context.lineTo(x + MARK_PIXELS * Math.cos(angle), y + MARK_PIXELS * Math.sin(angle));
    }
    context.closePath();
    context.fillStyle = filled ? colour("--planned") : colour("--free");
    context.strokeStyle = filled ? colour("--free") : colour("--planned");
    context.lineWidth = 2;
    context.fill();
    context.stroke();
  }

  // Text with a rim in the colour of the paper, readable on walls and paths.
  function write(context, text, x, y, ink, weight) {
    context.font = `${weight} 12px system-ui, sans-serif`;
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.lineWidth = 4;
    context.lineJoin = "round";
    context.strokeStyle = colour("--paper");
    context.strokeText(text, x, y);
    context.fillStyle = colour(ink);
    context.fillText(text, x, y);
  }

  function drawNames(context) {
    for (const { name, centre, anchor, half_size } of data.labels) {
      // A name that stands beside its area is joined to it, as in the pictures.
      const apart = anchor.some((place, axis) => Math.abs(place - centre[axis]) > half_size[axis]);
      const cells = [centre, anchor].map(([x, y]) => [y, x]);
      // A rim, as letters have: on a dark screen the ink of the page is as light as free space.
      if (apart) for (const [ink, width] of [["--paper", 3], ["--ink", 1]]) line(context, cells, colour(ink), width);
      write(context, name, (centre[0] + 0.5) * scale, (centre[1] + 0.5) * scale, "--ink", 400);
    }
  }

  function drawRobot(context) {
    context.beginPath();
    const [row, column] = data.path[step];
    context.arc((column + 0.5) * scale, (row + 0.5) * scale, Math.min(8, Math.max(4, scale / 2)), 0, 2 * Math.PI);
    context.fillStyle = "#FFD400";
    context.fill();
    context.lineWidth = 2;
    context.strokeStyle = "#222222";
    context.stroke();
  }

  function firstDecision() {
    return data.decisions.length && data.decisions[0].step === 0 ? 0 : -1;
  }

  // The decision that is carried out at a step: the last one taken there or before.
  function decisionAt(there) {
    let found = -1;
    data.decisions.forEach((decision, index) => { if (decision.step <= there) found = index; });
    return found;
  }

  function moveTo(there, decision = decisionAt(there)) {
    step = there;
    number = decision;
    show();
  }

  function showActions(decision) {
    const table = part(".actions");
    table.replaceChildren();
    if (!decision || !decision.actions.length) return;
    const head = table.createTHead().insertRow();
    for (const [name, meaning] of [["action", "subgoal and what is tried beyond it"], ...Object.entries(data.figures)]) {
      const cell = document.createElement("th"), text = document.createElement("abbr");
      cell.scope = "col";
      text.title = meaning;
      text.textContent = name;
      cell.append(text);
      head.append(cell);
    }
    const body = table.createTBody();
    for (const action of decision.actions) {
      const row = body.insertRow();
      if (action.chosen) row.className = "chosen";
      row.title = action.meaning;
      for (const text of [(action.chosen ? "▸ " : "") + action.name, ...action.figures]) row.insertCell().textContent = text;
    }
  }

  function showViews(decision) {
    const views = part(".views");
    views.replaceChildren();
    if (!decision) return;
    decision.observations.forEach((look, number) => {
      const source = data.panoramas[look];
      if (!source) return;
      const figure = document.createElement("figure"), image = document.createElement("img"), text = document.createElement("figcaption");
      const mine = isTarget(decision, decision.subgoals[number]);
      if (mine) figure.className = "chosen-view";
      rolled(source, turn(data.decisions[look].cell, decision.subgoals[number])).then((url) => { image.src = url; });
      text.textContent = `s${number} is in the middle${mine ? ", chosen" : ""}; seen ${look === decision.index ? "now" : `at decision ${look}`}`;
      image.alt = `panorama in which subgoal ${number} is in the middle`;
      figure.append(image, text);
      views.append(figure);
    });
    const own = data.panoramas[decision.index];
    if (decision.observations.length || !own) return;
    const figure = document.createElement("figure"), image = document.createElement("img"), text = document.createElement("figcaption");
    image.src = own;
    image.alt = "panorama of the decision";
    text.textContent = "seen from where the robot decided; the middle looks to the right on the map";
    figure.append(image, text);
    views.append(figure);
  }

  // Columns run from -pi to pi of the bearing (world/camera.py).
  function turn(from, to) {
    return Math.atan2(to[0] - from[0], to[1] - from[1]) / (2 * Math.PI);
  }

  function show() {
    slider.value = step;
    const decision = data.decisions[number], context = canvas.getContext("2d");
    drawCells(context);
    drawOverlay(context, decision);
    drawNames(context);
    drawPath(context);
    drawPlan(context, decision);
    drawRobot(context);
    const state = data.state_names[data.states[step]];
    part(".where").textContent = `step ${step} of ${last}, ${decisionInWords()}`;
    canvas.setAttribute("aria-label", `map after step ${step}: robot at row ${data.path[step][0]}, column ${data.path[step][1]}, ${state}`);
    part(".decision").textContent = decision ? decision.text : "";
    const expected = decision && decision.value !== null ? `, expected cost ${decision.value.toFixed(1)}` : "";
    part(".note").textContent = decision ? `In ${data.state_names[decision.state]}${expected}` : "";
    part(".key").hidden = !decision || !decision.actions.length;
    showActions(decision);
    showViews(decision);
    showReading(decision);
  }

  function decisionInWords() {
    const count = data.decisions.length;
    return count ? `decision ${number < 0 ? "-" : number} (last: ${count - 1})` : "no decisions";
  }

  function go(where) {
    const steps = data.decisions.map((decision) => decision.step);
    if (where === "step-back") moveTo(Math.max(0, step - 1));
    if (where === "step-on") moveTo(Math.min(last, step + 1));
    if (where === "decision-on") number + 1 < steps.length ? moveTo(steps[number + 1], number + 1) : moveTo(last);
    if (where === "decision-back") {
      const back = number >= 0 && steps[number] < step ? number : number - 1;
      back >= 0 ? moveTo(steps[back], back) : moveTo(0, firstDecision());
    }
    if (where === "start") moveTo(0, firstDecision());
    if (where === "end") moveTo(last);
  }

  root.addEventListener("click", (event) => {
    const button = event.target.closest("button[data-go]");
    if (button) go(button.dataset.go);
  });
  slider.addEventListener("input", () => moveTo(Number(slider.value)));
  part("select").addEventListener("change", (event) => {
    choice = choices[event.target.selectedIndex];
    showScale();
    show();
  });
  canvas.addEventListener("pointermove", (event) => {
    const box = canvas.getBoundingClientRect();
    const cell = [((event.clientY - box.top) / box.height) * rows, ((event.clientX - box.left) / box.width) * columns].map(Math.floor);
    if (cell[0] >= 0 && cell[0] < rows && cell[1] >= 0 && cell[1] < columns) showReading(data.decisions[number], cell);
  });
  canvas.addEventListener("pointerleave", () => showReading(data.decisions[number]));
  const keys = { ArrowLeft: "step-back", ArrowRight: "step-on", PageUp: "decision-back", PageDown: "decision-on", Home: "start", End: "end" };
  root.tabIndex = -1;
  root.addEventListener("keydown", (event) => {
    const where = keys[event.key];
    // Of the browser: with Alt it goes back a page, and the arrows move through a list.
    if (!where || event.altKey || event.ctrlKey || event.metaKey || event.shiftKey || event.target.matches("select")) return;
    event.preventDefault();
    go(where);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", show);
  show();
  slider.focus({ preventScroll: true });
}

// Cells moved to the right of the direction of travel, averaged over a few steps: a way back does not hide the way out.
function keepRight(path, offset) {
  return path.map(([row, column], step) => {
    const before = path[Math.max(0, step - 2)], after = path[Math.min(path.length - 1, step + 2)];
    const down = after[0] - before[0], across = after[1] - before[1], length = Math.hypot(down, across) || 1;
    return [row + (offset * across) / length, column - (offset * down) / length];
  });
}

function decodeIntegers(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Int32Array(bytes.buffer);
}

// The image moved by a fraction of its width, so that what is there comes to the middle.
async function rolled(source, fraction) {
  const image = new Image();
  image.src = source;
  await image.decode();
  const canvas = document.createElement("canvas");
  canvas.width = image.width;
  canvas.height = image.height;
  const shift = -Math.round(fraction * image.width), context = canvas.getContext("2d");
  for (const turn of [-1, 0, 1]) context.drawImage(image, shift + turn * image.width, 0);
  return canvas.toDataURL("image/png");
}

// Between two colours, "#rrggbb" or "rgb(r, g, b)", by a share of the second.
function mixed(first, second, share) {
  const [from, to] = [first, second].map((colour) => (colour[0] === "#" ? [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16)) : colour.match(/\d+/g).map(Number)));
  return `rgb(${from.map((value, part) => Math.round(value + (to[part] - value) * share)).join(", ")})`;
}

function percent(chance) {
  return `${Math.round(100 * chance)} %`;
}
