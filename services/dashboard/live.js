// The moving part of the page: the posterior on a canvas, the tables, and the times of the stages on another canvas.
//
//     /live (WebSocket) ──▶ newest message ──▶ drawn at the next animation frame
//
// Everything from topics is set as text, never as markup. No state of Vue is used, since it would be slow and leak.

// viridis at 9 places: even in brightness, also for colour-blind eyes
const VIRIDIS = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]];
const COLOURS = new Uint8ClampedArray(256 * 4);
for (let i = 0; i < 256; i++) {
  const share = (i / 255) * (VIRIDIS.length - 1), low = Math.min(Math.floor(share), VIRIDIS.length - 2);
  for (let c = 0; c < 3; c++) COLOURS[4 * i + c] = VIRIDIS[low][c] + (share - low) * (VIRIDIS[low + 1][c] - VIRIDIS[low][c]);
  COLOURS[4 * i + 3] = 255;
}
// Okabe and Ito's colours, which colour-blind eyes can tell apart
const STAGE_COLOURS = ["#0072b2", "#56b4e9", "#999999", "#009e73", "#e69f00", "#f0e442", "#cc79a7", "#d55e00"];
const OLD_MS = 2000;
const GRAB = 28;  // pixels from the boat within which it is picked up

const number = (value, digits = 4) => Number(Number(value).toPrecision(digits)).toString();
const centre = (axis, index) => axis.offset + index * axis.step;
const value = (axis, index) => axis.states.length ? axis.states[Math.round(index)] ?? "" : number(centre(axis, index));
const title = (axis) => axis.label + (axis.unit ? ` (${axis.unit})` : axis.known ? "" : " (cell)");
// the index at a share of an axis; numbers of cells and names are whole
const place = (axis, share) => axis.known && !axis.states.length ? share * (axis.size - 1) : Math.round(share * (axis.size - 1));
const age = (ms) => ms < 1000 ? `${Math.round(ms)} ms` : ms < 60e3 ? `${(ms / 1000).toFixed(1)} s` : `${Math.floor(ms / 60e3)} min`;
const setText = (element, text) => { if (element.textContent !== text) element.textContent = text; };

// Write on a canvas; begin a path along points; fill and outline the path, or only outline it without a filling.
const write = (context, align, text, x, y, width) => Object.assign(context, { textAlign: align }).fillText(text, x, y, width);
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
          <canvas ref="posterior" data-testid="posterior" class="bm-posterior" tabindex="0" role="img" aria-label="Posterior"></canvas>
          <p ref="legend" class="bm-legend" data-testid="legend"></p>
          <div ref="world" class="bm-world"></div>
        </section>
        <section>
          <h2>Readings</h2>
          <table data-testid="readings"><thead><tr><th>variable</th><th>value</th><th>address</th><th>age</th></tr></thead><tbody ref="readings"></tbody></table>
          <h2>Boards</h2>
          <table data-testid="boards"><thead><tr><th>board</th><th>stopped</th><th>cycles</th><th>state</th><th>image</th></tr></thead><tbody ref="boards"></tbody></table>
          <table data-testid="statistics"><tbody ref="statistics"></tbody></table>
        </section>
        <section class="bm-wide">
          <h2>Stages, the last five minutes</h2>
          <canvas ref="stages" data-testid="stage-times" class="bm-stages" role="img" aria-label="Times of the stages"></canvas>
          <ul ref="stageNames" class="bm-stage-names"></ul>
          <h2>Frames lost</h2>
          <table data-testid="losses"><thead><tr><th>reason</th><th>frames</th></tr></thead><tbody ref="losses"></tbody></table>
          <div ref="samplesPart" hidden>
            <h2>Samples</h2>
            <pre ref="samples" data-testid="samples"></pre>
          </div>
        </section>
      </div>
    </div>`,

  mounted() {
    document.documentElement.lang = "en";  // for screen readers; the framework names none
    this.live = { head: null, picture: null, heardAt: 0, stats: null, drag: null, image: document.createElement("canvas"), dirty: true };
    const canvas = this.$refs.posterior;
    canvas.addEventListener("pointerdown", (event) => this.pick(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => this.drop(event));
    canvas.addEventListener("keydown", (event) => this.key(event));
    this.resized = new ResizeObserver(() => { this.live.dirty = true; });
    this.resized.observe(canvas);
    this.resized.observe(this.$refs.stages);
    const turn = () => {
      this.turn();
      this.animation = requestAnimationFrame(turn);
    };
    this.animation = requestAnimationFrame(turn);
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
        live.head = head;
        live.picture = buffer.slice(4 + length);
        live.heardAt = performance.now();
        live.fresh = true;
      } else if (head.kind === "stats") {
        live.stats = head;
        live.statsFresh = true;
      } else if (head.kind === "notice") {
        setText(this.$refs.notice, head.text);
      }
      live.dirty = true;
    },
    tell(message) {
      if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
    },

    // --- each animation frame ---
    turn() {
      const live = this.live, now = performance.now();
      if (live.wanted) {  // at most one pose a frame
        this.tell({ pose: live.wanted });
        live.wanted = null;
      }
      if (live.head && now - (live.agedAt ?? 0) > 200) {
        live.agedAt = now;
        this.showAge(now);
      }
      if (!live.dirty) return;
      live.dirty = false;
      this.drawPosterior();
      if (live.fresh) {
        live.fresh = false;
        this.$refs.posterior.dataset.at = live.head.at;
        setText(this.$refs.number, live.head.number == null ? "?" : String(live.head.number));
        // tables change no faster than eyes follow
        if (now - (live.tabledAt ?? -1000) > 100 || live.head.paused) {
          live.tabledAt = now;
          this.showTables();
        }
      }
      if (live.statsFresh) {
        live.statsFresh = false;
        this.showStats();
      }
    },
    showAge(now) {
      const { head, heardAt } = this.live;
      const ms = head.age_ms + now - heardAt, old = ms > OLD_MS;
      this.$refs.posterior.classList.toggle("bm-old", old);
      this.$refs.age.classList.toggle("bm-old-text", old);
      const where = head.paused ? `paused, ${head.last - head.at} before the newest, ` : "";
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
      const rows = head.readings.map(([name, text, address, ms]) => [name, typeof text === "number" ? number(text, 9) : text, address, age(ms)]);
      fill(refs.readings, [...rows, ...head.missing.map((name) => [name, "missing", "", ""])], (at) => at < rows.length ? "" : "bm-missing");
      const known = stats?.boards ?? [];
      const boards = head.boards.length ? head.boards : known.map(([endpoint]) => [endpoint, "", null]);
      fill(refs.boards, boards.map((board, at) => [...board, known[at]?.[1] ?? "", (known[at]?.[2] ?? "").slice(0, 12)]));
      fill(refs.statistics, Object.entries(head.statistics).map(([key, text]) => [key.replaceAll("_", " "), text]));
      this.describe();
    },
    describe() {
      const { head, drag } = this.live, plot = head.plot;
      if (!plot) {
        setText(this.$refs.legend, `no posterior: ${head.outcome}`);
        return;
      }
      const parts = [`darkest 0, brightest ${number(plot.max, 3)}`];
      if (plot.axes.length === 1) parts[0] = `highest ${number(plot.max, 3)}`;
      if (plot.error != null) parts.push(`sampling error ±${number(plot.error, 2)}`);
      if (plot.mean) {
        const [down, across] = plot.axes;
        parts.push(`mean ${down.label} ${value(down, plot.mean[0])}, ${across.label} ${value(across, plot.mean[1])} (ellipse: 2 standard deviations)`);
      }
      const truth = drag ?? head.truth;
      if (truth) parts.push(`truth x ${number(truth[0], 3)}, y ${number(truth[1], 3)}`);
      setText(this.$refs.legend, parts.join("; "));
      const label = `Posterior of ${plot.axes.map((axis) => axis.label).join(" and ")}: ${parts.join("; ")}`;
      if (Date.now() - (this.live.describedAt ?? 0) > 2000) {  // no torrent for screen readers
        this.live.describedAt = Date.now();
        this.$refs.posterior.setAttribute("aria-label", label + (this.placed() && this.canDrag() ? ". Arrow keys move the boat" : ""));
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
      refs.samplesPart.hidden = !stats.samples;
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
          const label = document.createElement("label"), box = document.createElement("input"), short = name.replace(/^\/boat\//, "");
          box.type = "checkbox";
          box.setAttribute("role", "switch");
          box.dataset.name = name;
          box.dataset.testid = `switch-${short.replaceAll("/", "-")}`;
          box.onchange = () => {
            box.changedAt = performance.now();
            this.tell({ switch: name, on: box.checked });
          };
          label.append(box, ` ${short.replaceAll("/", " ")}`);
          return label;
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
      const x = (second) => left + (width - left) * (1 - second / 300), y = (time) => (height - bottom) * (1 - time / top) + 4 * time / top;
      context.clearRect(0, 0, width, height);
      const bar = Math.max((width - left) / 300, 1);
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
      const last = rows.at(-1)?.[1] ?? [], list = this.$refs.stageNames;
      if (list.children.length !== names.length) {
        list.replaceChildren(...names.map((_, at) => {
          const item = document.createElement("li"), swatch = document.createElement("span"), text = document.createElement("span");
          swatch.style.background = STAGE_COLOURS[at % STAGE_COLOURS.length];
          item.append(swatch, text);
          return item;
        }));
      }
      names.forEach((name, at) => setText(list.children[at].lastChild, ` ${name.replaceAll("_", " ")} ${last.length ? `${number(last[at], 3)} µs` : ""}`));
    },

    // --- the posterior ---
    // Fit a canvas to its element and to the screen's pixels; return its context and its size.
    prepare(canvas) {
      const scale = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
      if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
        canvas.width = Math.round(width * scale);
        canvas.height = Math.round(height * scale);
      }
      const context = canvas.getContext("2d");
      context.setTransform(scale, 0, 0, scale, 0, 0);
      return [context, width, height];
    },
    drawPosterior() {
      const { head, picture } = this.live, canvas = this.$refs.posterior, [context, width, height] = this.prepare(canvas);
      const { color } = getComputedStyle(this.$el);
      context.clearRect(0, 0, width, height);
      Object.assign(context, { fillStyle: color, strokeStyle: color, font: "12px sans-serif", lineWidth: 1 });
      this.live.box = null;
      if (!head?.plot) write(context, "center", head ? `no posterior: ${head.outcome}` : "waiting for the first posterior", width / 2, height / 2, width - 20);
      else if (head.plot.axes.length === 1) this.drawBars(context, width, height, head.plot, new Float32Array(picture));
      else this.drawGrid(context, width, height, head, new Uint8Array(picture));
    },
    drawGrid(context, width, height, head, cells) {
      const [down, across] = head.plot.axes, left = 62, bottom = 40, top = 8, right = 12;
      // cells are squares where both axes have the same unit
      let w = width - left - right, h = height - top - bottom;
      if (down.known === across.known && down.unit === across.unit && !down.states.length && !across.states.length) {
        const ratio = Math.abs((across.size * across.step) / (down.size * down.step));
        if (w / h > ratio) w = h * ratio; else h = w / ratio;
      }
      const box = this.live.box = { left, top, w, h, down, across }, image = this.live.image;
      if (image.width !== across.size || image.height !== down.size) [image.width, image.height] = [across.size, down.size];
      const pixels = new ImageData(across.size, down.size), words = new Uint32Array(pixels.data.buffer), colours = new Uint32Array(COLOURS.buffer);
      for (let row = 0; row < down.size; row++) {  // the first row is at the bottom, as on a map
        const from = row * across.size, to = (down.size - 1 - row) * across.size;
        for (let column = 0; column < across.size; column++) words[to + column] = colours[cells[from + column]];
      }
      image.getContext("2d").putImageData(pixels, 0, 0);
      context.imageSmoothingEnabled = false;
      context.drawImage(image, left, top, w, h);
      context.strokeRect(left, top, w, h);
      this.drawTicks(context, box);
      context.save();
      context.beginPath();
      context.rect(left, top, w, h);
      context.clip();
      const plot = head.plot;
      if (plot.mean) this.drawMean(context, box, plot.mean, plot.covariance);
      context.restore();
      // landmarks and shores are on the edge, or beyond it
      const stats = this.live.stats;
      for (const [x, y, name] of stats?.landmarks ?? []) this.drawLandmark(context, this.pixel(x, y), name, width, height);
      const truth = this.live.drag ?? head.truth ?? stats?.truth;
      if (truth) this.drawTruth(context, this.pixel(...truth));
    },
    drawTicks(context, { left, top, w, h, down, across }) {
      const count = Math.max(2, Math.min(5, Math.floor(w / 70)));
      for (let at = 0; at < count; at++) {
        const index = place(across, at / (count - 1));
        write(context, "center", value(across, index), left + (index + 0.5) / across.size * w, top + h + 15, w / count);
      }
      write(context, "center", title(across), left + w / 2, top + h + 33, w);
      for (let at = 0; at < 5; at++) {
        const index = place(down, at / 4);
        write(context, "right", value(down, index), left - 5, top + h - (index + 0.5) / down.size * h + 4, 40);
      }
      context.save();
      context.translate(13, top + h / 2);
      context.rotate(-Math.PI / 2);
      write(context, "center", title(down), 0, 0, h);
      context.restore();
    },
    drawMean(context, { left, top, w, h, down, across }, [row, column], [rr, rc, cc]) {
      const x = left + (column + 0.5) / across.size * w, y = top + h - (row + 0.5) / down.size * h;
      Object.assign(this.$refs.posterior.dataset, { meanX: x.toFixed(1), meanY: y.toFixed(1) });  // where tests find it
      // in pixels, with y downwards
      const sx = w / across.size, sy = h / down.size, a = cc * sx * sx, b = -rc * sx * sy, c = rr * sy * sy;
      const middle = (a + c) / 2, spread = Math.hypot((a - c) / 2, b), angle = Math.atan2(2 * b, a - c) / 2;
      for (const [line, style] of [[4, "#000"], [2, "#fff"]]) {
        context.beginPath();
        context.ellipse(x, y, 2 * Math.sqrt(Math.max(middle + spread, 0)), 2 * Math.sqrt(Math.max(middle - spread, 0)), angle, 0, 2 * Math.PI);
        paint(context, line, style);
        path(context, [x - 6, y], [x + 6, y], [x, y], [x, y - 6], [x, y + 6]);
        paint(context, line, style);
      }
    },
    drawLandmark(context, place, name, width, height) {
      if (!place) return;
      const [x, y] = place;
      if (x < 0 || x > width || y < 0 || y > height) return;
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
    drawBars(context, width, height, { axes: [axis], max, error }, bars) {
      const left = 48, bottom = 40, top = 12, w = width - left - 8, h = height - top - bottom;
      const high = bars.length > 10 ? Math.min(1, max + (error ?? 0)) || 1 : 1, step = w / axis.size, y = (p) => top + h * (1 - Math.min(p / high, 1));
      const colour = context.fillStyle;
      bars.forEach((p, at) => {
        const x = left + at * step, gap = step > 6 ? step * 0.1 : 0;
        context.fillStyle = "#0072b2";
        context.fillRect(x + gap, y(p), Math.max(step - 2 * gap, 1), top + h - y(p));
        if (error == null) return;
        path(context, [x + step / 2, y(Math.max(p - error, 0))], [x + step / 2, y(p + error)]);
        paint(context, 2, "#d55e00");
      });
      Object.assign(context, { fillStyle: colour, strokeStyle: colour, lineWidth: 1 }).strokeRect(left, top, w, h);
      write(context, "right", number(high, 3), left - 4, top + 8);
      write(context, "right", "0", left - 4, top + h);
      const every = Math.ceil(axis.size / Math.max(1, Math.floor(w / 60)));
      for (let at = 0; at < axis.size; at += every) write(context, "center", value(axis, at), left + (at + 0.5) * step, top + h + 15, every * step);
      write(context, "center", title(axis), left + w / 2, top + h + 33, w);
    },

    // --- the boat ---
    // Pixel of a place in the world, and the other way round; null if the axes are not x and y with values.
    placed() {
      const box = this.live.box;
      return box && box.down.known && box.across.known && box.down.label === "y" && box.across.label === "x" ? box : null;
    },
    pixel(x, y) {
      const box = this.placed();
      if (!box) return null;
      const column = (x - box.across.offset) / box.across.step, row = (y - box.down.offset) / box.down.step;
      return [box.left + (column + 0.5) / box.across.size * box.w, box.top + box.h - (row + 0.5) / box.down.size * box.h];
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
    pick(event) {
      const boat = this.boat();
      if (!this.canDrag() || !this.placed() || !boat) return;
      const [x, y] = this.pixel(...boat);
      if (Math.hypot(event.offsetX - x, event.offsetY - y) > GRAB) return;
      event.preventDefault();
      this.$refs.posterior.focus();
      this.$refs.posterior.setPointerCapture(event.pointerId);
      this.live.pointer = event.pointerId;
      this.put(event.offsetX, event.offsetY);
    },
    move(event) {
      if (this.live.pointer === event.pointerId && this.placed()) this.put(event.offsetX, event.offsetY);
    },
    drop(event) {
      if (this.live.pointer !== event.pointerId) return;
      this.live.pointer = null;
      this.letGo();
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
      const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key], boat = this.boat();
      if (!by || !boat || !this.canDrag() || !this.placed()) return;
      event.preventDefault();
      const { across, down } = this.placed(), cells = event.shiftKey ? 5 : 1;
      const [px, py] = this.pixel(boat[0] + by[0] * cells * Math.abs(across.step), boat[1] + by[1] * cells * Math.abs(down.step));
      this.put(px, py);
      this.letGo();
    },

    // --- saving ---
    savePng(name) {
      this.$refs.posterior.toBlob((blob) => {
        const link = document.createElement("a");
        link.href = URL.createObjectURL(blob);
        link.download = name;
        link.click();
        setTimeout(() => URL.revokeObjectURL(link.href), 1000);
      });
    },
  },
};
