// The moving part of the page: the posterior on a canvas, the tables, and the times of the stages on another canvas.
//
//     /live (WebSocket) ──▶ newest message ──▶ drawn at the next animation frame
//
// Everything from topics is set as text, never as markup. No state of Vue is used, since it would be slow and leak.

// viridis at 9 places: even in brightness, also for colour-blind eyes
const VIRIDIS = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129],
  [92, 200, 99], [170, 220, 50], [253, 231, 37]];
const COLOURS = new Uint8ClampedArray(256 * 4);
for (let i = 0; i < 256; i++) {
  const share = (i / 255) * (VIRIDIS.length - 1), low = Math.min(Math.floor(share), VIRIDIS.length - 2);
  COLOURS.set([...VIRIDIS[low].map((from, c) => from + (share - low) * (VIRIDIS[low + 1][c] - from)), 255], 4 * i);
}
// Okabe and Ito's colours, which colour-blind eyes can tell apart
const STAGE_COLOURS = ["#0072b2", "#56b4e9", "#999999", "#009e73", "#e69f00", "#f0e442", "#cc79a7", "#d55e00"];
const OLD_MS = 2000;
const GRAB = 28;  // pixels from the boat within which it is picked up

const number = (value, digits = 4) => Number(Number(value).toPrecision(digits)).toString();
const centre = (axis, index) => axis.offset + index * axis.step;
const value = (axis, index) => axis.states.length ? axis.states[Math.round(index)] ?? "" : number(centre(axis, index));
const title = (axis) => axis.label + (axis.unit ? ` (${axis.unit})` : axis.known ? "" : " (cell)");
const hasValues = (axis) => axis.known && !axis.states.length;
// the index at a share of an axis; numbers of cells and names are whole
const place = (axis, share) => (hasValues(axis) ? Number : Math.round)(share * (axis.size - 1));
const minutes = (ms) => ms < 60e3 ? `${(ms / 1000).toFixed(1)} s` : `${Math.floor(ms / 60e3)} min`;
const age = (ms) => ms < 1000 ? `${Math.round(ms)} ms` : minutes(ms);
const setText = (element, text) => { if (element.textContent !== text) element.textContent = text; };

function resize(canvas, width, height) {  // only if it is new, because it clears the canvas
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
}
// Write on a canvas; begin a path along points; fill and outline the path, or only outline it without a filling.
const write = (context, textAlign, text, ...where) => Object.assign(context, { textAlign }).fillText(text, ...where);
function path(context, ...points) {
  context.beginPath();
  points.forEach(([x, y], at) => at ? context.lineTo(x, y) : context.moveTo(x, y));
}
function paint(context, lineWidth, strokeStyle, fillStyle) {
  Object.assign(context, { lineWidth, strokeStyle });
  if (fillStyle) Object.assign(context, { fillStyle }).fill();
  context.stroke();
}

// Show rows of texts in the body of a table; rows and cells that are there already are used again.
function fill(body, rows, mark) {
  while (body.rows.length > rows.length) body.deleteRow(-1);
  rows.forEach((texts, at) => {
    const row = body.rows[at] ?? body.insertRow();
    while (row.cells.length < texts.length) row.insertCell();
    texts.forEach((text, column) => setText(row.cells[column], text == null ? "" : String(text)));
    row.className = mark ? mark(at) : "";
  });
}

const table = (name, ...heads) => `<table data-testid="${name}"><thead><tr>
  ${heads.map((head) => `<th>${head}</th>`).join("")}</tr></thead><tbody ref="${name}"></tbody></table>`;
const swatch = (colour) => `<li hidden><span style="background: ${colour}"></span><span></span></li>`;
const make = (tag, properties, ...parts) => {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...parts);
  return element;
};

export default {
  props: { view: String },
  template: `
    <div class="bm-live">
      <div class="bm-state">
        <span ref="connection" data-testid="connection" role="status"></span>
        <span>frame <b ref="number" data-testid="frame-number">-</b></span>
        <span ref="outcome" data-testid="outcome"></span>
        <span ref="cycles"></span>
        <span ref="age" data-testid="age"></span>
        <span ref="rate" data-testid="rate"></span>
      </div>
      <p ref="notice" class="bm-notice" role="alert"></p>
      <div class="bm-panels">
        <section>
          <canvas ref="posterior" data-testid="posterior" class="bm-posterior" tabindex="0" role="img"
            aria-label="Posterior"></canvas>
          <p ref="legend" class="bm-legend" data-testid="legend"></p>
          <div ref="world" class="bm-world"></div>
        </section>
        <section>
          <h2>Readings</h2>
          ${table("readings", "variable", "value", "address", "age")}
          <h2>Boards</h2>
          ${table("boards", "board", "stopped", "cycles", "state", "image")}
          ${table("statistics")}
        </section>
        <section class="bm-wide">
          <h2>Stages, the last five minutes</h2>
          <canvas ref="stages" data-testid="stage-times" class="bm-stages" role="img"
            aria-label="Times of the stages"></canvas>
          <ul ref="stageNames" class="bm-stage-names">${STAGE_COLOURS.map(swatch).join("")}</ul>
          <h2>Frames lost</h2>
          ${table("losses", "reason", "frames")}
          <div ref="samplesPart" hidden>
            <h2>Samples of the last frames</h2>
            <pre ref="samples" data-testid="samples"></pre>
          </div>
        </section>
      </div>
    </div>`,

  mounted() {
    document.documentElement.lang = "en";  // for screen readers; the framework names none
    this.live = { head: null, picture: null, heardAt: 0, stats: null, drag: null, image: make("canvas"), dirty: true };
    const { posterior, stages } = this.$refs, pointing = ["pointerdown", "pointermove", "pointerup", "pointercancel"];
    for (const type of pointing) posterior.addEventListener(type, this.point);
    posterior.addEventListener("keydown", this.key);
    this.resized = new ResizeObserver(() => { this.live.dirty = true; });
    for (const canvas of [posterior, stages]) this.resized.observe(canvas);
    this.turn();
    this.connect();
  },

  unmounted() {
    cancelAnimationFrame(this.animation);
    this.resized.disconnect();
    clearTimeout(this.again);
    this.gone = true;
    this.socket?.close();
  },

  methods: {
    // --- messages ---
    connect() {
      const scheme = location.protocol === "https:" ? "wss" : "ws";
      const socket = new WebSocket(`${scheme}://${location.host}/live?view=${encodeURIComponent(this.view)}`);
      socket.binaryType = "arraybuffer";
      socket.onmessage = (event) => {
        this.take(event.data);
        socket.send(".");  // the next one may come: a slow browser gets fewer frames, not older ones
      };
      socket.onclose = () => {
        if (this.gone) return;
        this.live.stats = null;
        this.showConnection();
        this.again = setTimeout(() => this.connect(), 1000);
      };
      this.socket = socket;
    },
    take(buffer) {
      const length = new DataView(buffer).getUint32(0, true);
      const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
      const live = this.live;
      if (head.kind === "frame") {
        Object.assign(live, { head, picture: buffer.slice(4 + length), heardAt: performance.now(), fresh: true });
      } else if (head.kind === "stats") Object.assign(live, { stats: head, statsFresh: true });
      else if (head.kind === "notice") setText(this.$refs.notice, head.text);
      live.dirty = true;
    },
    tell(message) {
      if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
    },

    // --- each animation frame ---
    turn() {
      const live = this.live, now = performance.now();
      this.animation = requestAnimationFrame(this.turn);
      if (live.wanted) {  // at most one pose a frame
        this.tell({ pose: live.wanted });
        live.wanted = null;
      }
      if (live.head && now - (live.agedAt ?? 0) > 200) {
        live.agedAt = now;
        this.showAge(now);
      }
      if (live.dirty) this.drawPosterior();
      live.dirty = false;
      if (live.fresh) {
        live.fresh = false;
        this.$refs.posterior.dataset.at = live.head.at;
        setText(this.$refs.number, live.head.number == null ? "?" : String(live.head.number));
        live.untabled = true;
      }
      // tables change no faster than eyes follow
      if (live.untabled && (now - (live.tabledAt ?? -1000) > 80 || live.head.paused)) {
        Object.assign(live, { untabled: false, tabledAt: now });
        this.showTables();
      }
      if (live.statsFresh) {
        live.statsFresh = false;
        this.showStats();
      }
    },
    showAge(now) {
      const { head, heardAt } = this.live;
      const ms = head.age_ms + now - heardAt, old = ms > OLD_MS && !head.paused;
      this.$refs.posterior.classList.toggle("bm-old", old);
      this.$refs.age.classList.toggle("bm-old-text", old);
      const last = Math.max(head.last, this.live.stats?.last ?? 0);
      const where = head.paused ? `paused, ${last - head.at} before the newest, ` : "";
      setText(this.$refs.age, `${where}${age(ms)} old`);
    },
    showConnection() {
      const stats = this.live.stats;
      setText(this.$refs.connection, stats ? stats.state : "the dashboard does not answer; trying again");
      this.$refs.connection.className = stats?.connected ? "bm-good" : "bm-bad";
    },
    showTables() {
      const { head, stats } = this.live, refs = this.$refs;
      setText(refs.outcome, head.outcome);
      setText(refs.cycles, head.cycles == null ? "" : `${head.cycles} cycles`);
      const rows = head.readings.map(([name, found, address, ms, unit]) => {
        const shown = typeof found === "number" ? `${number(found, 9)} ${unit}`.trimEnd() : found;
        return [name, shown, address, age(ms)];
      });
      const missing = head.missing.map((name) => [name, "missing", "", ""]);
      fill(refs.readings, [...rows, ...missing], (at) => at < rows.length ? "" : "bm-missing");
      const known = stats?.boards ?? [];
      const boards = head.boards.length ? head.boards : known.map(([endpoint]) => [endpoint, "", null]);
      fill(refs.boards, boards.map((board, at) => [...board, known[at]?.[1], known[at]?.[2].slice(0, 12)]));
      fill(refs.statistics, Object.entries(head.statistics).map(([key, text]) => [key.replaceAll("_", " "), text]));
      this.describe();
    },
    describe() {
      const { head, drag } = this.live, plot = head.plot;
      if (!plot) return setText(this.$refs.legend, head.outcome);
      const parts = [`${plot.axes.length === 1 ? "highest" : "darkest 0, brightest"} ${number(plot.max, 3)}`];
      if (plot.error != null) parts.push(`sampling error ±${number(plot.error, 2)}`);
      if (plot.mean) {
        const [down, across] = plot.axes;
        const mean = `mean ${across.label} ${value(across, plot.mean[1])}, ${down.label} ${value(down, plot.mean[0])}`;
        parts.push(`${mean} (ellipse: 2 standard deviations)`);
      }
      const truth = this.placed() && (drag ?? head.truth);
      if (truth) parts.push(`truth x ${number(truth[0], 3)}, y ${number(truth[1], 3)}`);
      setText(this.$refs.legend, parts.join("; "));
      const label = `Posterior of ${plot.axes.map((axis) => axis.label).join(" and ")}: ${parts.join("; ")}`;
      if (Date.now() - (this.live.describedAt ?? 0) > 2000) {  // no torrent for screen readers
        this.live.describedAt = Date.now();
        const help = this.placed() && this.canDrag() ? ". Arrow keys move the boat" : "";
        this.$refs.posterior.setAttribute("aria-label", label + help);
      }
    },

    // --- statistics, twice a second ---
    showStats() {
      const stats = this.live.stats, refs = this.$refs;
      this.showConnection();
      setText(refs.rate, `${number(stats.rate, 3)} results/s`);
      const lost = Object.entries(stats.lost);
      fill(refs.losses, lost.length ? lost : [["none", 0]]);
      if (stats.why.length) setText(refs.notice, stats.why.join("; "));
      else if (this.live.hadWhy) setText(refs.notice, "");
      this.live.hadWhy = stats.why.length > 0;
      setText(refs.samples, stats.samples);
      refs.samplesPart.hidden = !stats.samples || this.live.head?.paused;  // they are not those of one frame
      refs.posterior.classList.toggle("bm-draggable", this.canDrag());
      this.showSwitches(stats.switches);
      this.drawStages(stats.stages, stats.stage_names);
      if (this.live.head) this.describe();
    },
    showSwitches(switches) {
      const world = this.$refs.world, names = Object.keys(switches);
      if (world.dataset.names !== names.join()) {
        world.dataset.names = names.join();
        world.replaceChildren(...names.map((name) => {
          const box = make("input", { type: "checkbox" }), short = name.replace(/^\/boat\//, "");
          box.setAttribute("role", "switch");
          Object.assign(box.dataset, { name, testid: `switch-${short.replaceAll("/", "-")}` });
          box.onchange = () => {
            box.changedAt = performance.now();
            this.tell({ switch: name, on: box.checked });
          };
          return make("label", {}, box, ` ${short.replaceAll("/", " ")}`);
        }));
      }
      for (const box of world.querySelectorAll("input")) {
        // not while the service is asked
        if (performance.now() - (box.changedAt ?? -2000) > 1500) box.checked = switches[box.dataset.name];
        box.disabled = !this.live.stats.connected;
      }
    },
    drawStages(rows, names) {
      const [context, width, height] = this.prepare(this.$refs.stages), left = 48, bottom = 18;
      const totals = rows.map(([, times]) => times.reduce((sum, time) => sum + time, 0)), top = Math.max(...totals, 1);
      const x = (second) => left + (width - left) * (1 - second / 300), bar = Math.max((width - left) / 300, 1);
      const y = (time) => (height - bottom) * (1 - time / top) + 4 * time / top;
      context.clearRect(0, 0, width, height);
      rows.forEach(([second, times]) => {
        let sum = 0;
        times.forEach((time, at) => {
          context.fillStyle = STAGE_COLOURS[at % STAGE_COLOURS.length];
          context.fillRect(x(second), y(sum + time), bar + 0.5, y(sum) - y(sum + time));
          sum += time;
        });
      });
      Object.assign(context, { fillStyle: getComputedStyle(this.$el).color, font: "12px sans-serif" });
      write(context, "right", `${number(top / 1000, 2)} ms`, left - 4, 14);
      write(context, "right", "0", left - 4, height - bottom);
      write(context, "left", "5 min ago", left, height - 4);
      write(context, "right", "now", width - 2, height - 4);
      const last = rows.at(-1)?.[1];
      [...this.$refs.stageNames.children].slice(0, names.length).forEach((item, at) => {
        item.hidden = false;
        setText(item.lastChild, ` ${names[at].replaceAll("_", " ")} ${last ? `${number(last[at], 3)} µs` : ""}`);
      });
    },

    // --- the posterior ---
    // Fit a canvas to its element and to the screen's pixels; return its context and its size.
    prepare(canvas) {
      const scale = devicePixelRatio || 1, { clientWidth, clientHeight } = canvas;
      resize(canvas, Math.round(clientWidth * scale), Math.round(clientHeight * scale));
      const context = canvas.getContext("2d");
      context.setTransform(scale, 0, 0, scale, 0, 0);
      return [context, clientWidth, clientHeight];
    },
    drawPosterior() {
      const { head, picture } = this.live, [context, width, height] = this.prepare(this.$refs.posterior);
      const { color } = getComputedStyle(this.$el), plot = head?.plot;
      context.clearRect(0, 0, width, height);
      Object.assign(context, { fillStyle: color, strokeStyle: color, font: "12px sans-serif", lineWidth: 1 });
      this.live.box = null;
      if (plot) this.live.grid = plot.axes.length === 1 ? null : { axes: plot.axes };
      if (plot?.axes.length === 1) {
        return this.drawBars(context, width, height, plot, new Float32Array(picture));
      }
      // without a posterior, the last map stays, empty: boat and landmarks are still there
      const shown = plot ?? this.live.grid;
      if (shown) this.drawGrid(context, width, height, head, shown, plot && new Uint8Array(picture));
      if (plot) return;
      Object.assign(context, { fillStyle: color });
      const why = head ? head.outcome : "waiting for the first posterior";
      write(context, "center", why, width / 2, height / 2, width - 20);
    },
    drawGrid(context, width, height, head, plot, cells) {
      const [down, across] = plot.axes, left = 62, bottom = 40, top = 8, right = 12;
      // cells are squares where both axes have the same unit
      let w = width - left - right, h = height - top - bottom;
      if (down.known === across.known && down.unit === across.unit && !(down.states.length + across.states.length)) {
        const ratio = Math.abs((across.size * across.step) / (down.size * down.step));
        if (w / h > ratio) w = h * ratio; else h = w / ratio;
      }
      const rows = down.size, columns = across.size, pixels = new ImageData(columns, rows), { image } = this.live;
      const x = (column) => left + (column + 0.5) / columns * w, y = (row) => top + h - (row + 0.5) / rows * h;
      const box = this.live.box = { left, top, w, h, down, across, x, y };
      const words = new Uint32Array(pixels.data.buffer), colours = new Uint32Array(COLOURS.buffer);
      for (let row = 0; cells && row < rows; row++) {  // the first row is at the bottom, as on a map
        const from = row * columns, to = (rows - 1 - row) * columns;
        for (let column = 0; column < columns; column++) words[to + column] = colours[cells[from + column]];
      }
      resize(image, columns, rows);
      image.getContext("2d").putImageData(pixels, 0, 0);
      context.imageSmoothingEnabled = false;
      context.drawImage(image, left, top, w, h);
      context.strokeRect(left, top, w, h);
      this.drawTicks(context, box);
      const { stats } = this.live;
      context.save();
      context.beginPath();
      context.rect(left, top, w, h);
      context.clip();
      if (plot.mean) this.drawMean(context, box, plot.mean, plot.covariance);
      context.restore();
      for (const [x, y, name] of stats?.landmarks ?? []) {  // they are on the edge, or beyond it
        this.drawLandmark(context, this.pixel(x, y), name, width, height);
      }
      const truth = this.live.drag ?? head.truth ?? stats?.truth;
      if (truth) this.drawTruth(context, this.pixel(...truth));
    },
    drawTicks(context, { left, top, w, h, down, across, x, y }) {
      const count = Math.max(2, Math.min(5, Math.floor(w / 70)));
      for (let at = 0; at < count; at++) {
        const index = place(across, at / (count - 1));
        write(context, "center", value(across, index), x(index), top + h + 15, w / count);
      }
      write(context, "center", title(across), left + w / 2, top + h + 33, w);
      for (let at = 0; at < 5; at++) {
        const index = place(down, at / 4);
        write(context, "right", value(down, index), left - 5, y(index) + 4, 40);
      }
      context.save();
      context.translate(13, top + h / 2);
      context.rotate(-Math.PI / 2);
      write(context, "center", title(down), 0, 0, h);
      context.restore();
    },
    drawMean(context, { w, h, down, across, ...box }, [row, column], [rr, rc, cc]) {
      const x = box.x(column), y = box.y(row);
      Object.assign(this.$refs.posterior.dataset, { meanX: x.toFixed(1), meanY: y.toFixed(1) });  // where tests find it
      // in pixels, with y downwards
      const sx = w / across.size, sy = h / down.size, a = cc * sx * sx, b = -rc * sx * sy, c = rr * sy * sy;
      const middle = (a + c) / 2, spread = Math.hypot((a - c) / 2, b), angle = Math.atan2(2 * b, a - c) / 2;
      const radii = [middle + spread, middle - spread].map((square) => 2 * Math.sqrt(Math.max(square, 0)));
      for (const [line, style] of [[4, "#000"], [2, "#fff"]]) {
        context.beginPath();
        context.ellipse(x, y, ...radii, angle, 0, 2 * Math.PI);
        paint(context, line, style);
        path(context, [x - 6, y], [x + 6, y], [x, y], [x, y - 6], [x, y + 6]);
        paint(context, line, style);
      }
    },
    drawLandmark(context, place, name, width, height) {
      const [x, y] = place ?? [];
      if (!(x >= 0 && x <= width && y >= 0 && y <= height)) return;
      path(context, [x, y - 7], [x + 7, y + 6], [x - 7, y + 6], [x, y - 7]);
      paint(context, 1.5, "#000", "#e69f00");
      const [align, to] = x < width / 2 ? ["left", x + 10] : ["right", x - 10];  // inwards, where no axis is
      Object.assign(context, { textAlign: align, lineWidth: 3, fillStyle: "#fff" }).strokeText(name, to, y - 4, 120);
      context.fillText(name, to, y - 4, 120);
    },
    drawTruth(context, place) {
      if (!place) return;
      const [x, y] = place;
      context.beginPath();
      context.arc(x, y, this.live.drag ? 11 : 8, 0, 2 * Math.PI);
      paint(context, 2.5, "#fff", "#d55e00");
      Object.assign(this.$refs.posterior.dataset, { boatX: x.toFixed(1), boatY: y.toFixed(1) });
    },
    drawBars(context, width, height, { axes: [axis], max, error }, numbers) {
      const left = 48, bottom = 40, top = 12, w = width - left - 8, h = height - top - bottom;
      const high = axis.size > 10 ? Math.min(1, max + (error ?? 0)) || 1 : 1, step = w / axis.size;
      const y = (p) => top + h * (1 - Math.min(p / high, 1)), colour = context.fillStyle;
      const errors = numbers.subarray(axis.size);  // empty if they are not known
      numbers.subarray(0, axis.size).forEach((p, at) => {
        const x = left + at * step, gap = step > 6 ? step * 0.1 : 0;
        context.fillStyle = "#0072b2";
        context.fillRect(x + gap, y(p), Math.max(step - 2 * gap, 1), top + h - y(p));
        if (!errors.length) return;
        path(context, [x + step / 2, y(Math.max(p - errors[at], 0))], [x + step / 2, y(p + errors[at])]);
        paint(context, 2, "#d55e00");
      });
      Object.assign(context, { fillStyle: colour, strokeStyle: colour, lineWidth: 1 }).strokeRect(left, top, w, h);
      write(context, "right", number(high, 3), left - 4, top + 8);
      write(context, "right", "0", left - 4, top + h);
      const every = Math.ceil(axis.size / Math.max(1, Math.floor(w / 60)));
      for (let at = 0; at < axis.size; at += every) {
        write(context, "center", value(axis, at), left + (at + 0.5) * step, top + h + 15, every * step);
      }
      write(context, "center", title(axis), left + w / 2, top + h + 33, w);
    },

    // --- the boat ---
    // Pixel of a place in the world, and the other way round; null if the axes are not x and y with values.
    placed() {
      const { box } = this.live, labels = box && `${box.down.label} ${box.across.label}`;
      return labels === "y x" && box.down.known && box.across.known ? box : null;
    },
    pixel(x, y) {
      const box = this.placed();
      const index = (axis, at) => (at - axis.offset) / axis.step;
      return box && [box.x(index(box.across, x)), box.y(index(box.down, y))];
    },
    world(px, py) {
      const box = this.placed(), inside = (share) => Math.min(Math.max(share, 0), 1);
      return [
        centre(box.across, inside((px - box.left) / box.w) * box.across.size - 0.5),
        centre(box.down, inside((box.top + box.h - py) / box.h) * box.down.size - 0.5),
      ];
    },
    canDrag() {
      return Boolean(this.live.stats?.connected && this.live.stats.can_set_pose && !this.live.head?.paused);
    },
    boat() {
      return this.live.drag ?? this.live.head?.truth ?? this.live.stats?.truth;
    },
    // Pick the boat up near it, move it, and drop it.
    point(event) {
      const { live } = this, { pointerId, offsetX, offsetY, target } = event;
      if (event.type === "pointerdown") {
        const boat = this.canDrag() && this.placed() && this.boat(), [x, y] = boat ? this.pixel(...boat) : [];
        if (!boat || Math.hypot(offsetX - x, offsetY - y) > GRAB) return;
        event.preventDefault();
        target.focus();
        target.setPointerCapture(pointerId);
        live.pointer = pointerId;
      } else if (live.pointer !== pointerId) return;
      if (event.type === "pointerup" || event.type === "pointercancel") {
        live.pointer = null;
        this.letGo();
      } else if (this.placed()) this.put(offsetX, offsetY);
    },
    put(px, py) {
      this.live.drag = this.live.wanted = this.world(px, py);
      this.live.dirty = true;
    },
    // Show the boat where it was put until its own topic says so, which takes a moment.
    letGo() {
      clearTimeout(this.letting);
      this.letting = setTimeout(() => {
        this.live.drag = null;
        this.live.dirty = true;
      }, 400);
    },
    key(event) {
      const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      const boat = this.boat();
      if (!by || !boat || !this.canDrag() || !this.placed()) return;
      event.preventDefault();
      const { across, down } = this.placed(), cells = event.shiftKey ? 5 : 1;
      const moved = [across, down].map((axis, at) => boat[at] + by[at] * cells * Math.abs(axis.step));
      this.put(...this.pixel(...moved));
      this.letGo();
    },

    // --- saving ---
    savePng(name) {
      make("a", { href: this.$refs.posterior.toDataURL(), download: name }).click();
    },
  },
};
