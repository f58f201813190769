/* Figures to pan and zoom. A figure holds its data as JSON beside its still picture, which stays for print
   and where no script runs. Loaded after uPlot, which draws axes, lines and legends. */
(() => {
  "use strict";
  const INK = "#1f2933", MUTED = "#66727f", GRID = "#dde3e8";
  const BAND = "#d5dbe1", STRETCH = "#f3efe2", BLANK = "#eceff2";
  const FONT = "12px system-ui, sans-serif";
  const STEP = 0.2, FACTOR = 1.6, FINGER_MARGIN = 24;

  /* Numbers as little-endian 32 bit, base 64. */
  const numbers = (text) =>
    new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);

  const element = (tag, name, text) => {
    const made = document.createElement(tag);
    if (name) made.className = name;
    if (text !== undefined) made.textContent = text;
    return made;
  };

  const written = (value) =>
    value == null || !Number.isFinite(value) ? "–" : String(Number(value.toPrecision(4))).replace("-", "−");

  /* What is visible along each axis: a range within the whole, no narrower than the least. */
  class Visible {
    constructor(whole, least) {
      this.whole = whole;
      this.least = least;
      this.range = whole.map((r) => r.slice());
      this.changed = () => {};
    }

    set(range) {
      this.range = range.map(([from, to], k) => {
        const [low, high] = this.whole[k];
        const width = Math.min(Math.max(to - from, this.least[k]), high - low);
        const start = Math.min(Math.max((from + to - width) / 2, low), high - width);
        return [start, start + width];
      });
      this.changed();
    }

    /* A factor above 1 shows less; `at` is where a point stays, as shares of the visible ranges. */
    zoom(factor, at = [0.5, 0.5]) {
      this.set(this.range.map(([a, b], k) => {
        const point = a + at[k] * (b - a), half = (b - a) / factor;
        return [point - at[k] * half, point + (1 - at[k]) * half];
      }));
    }

    /* By shares of the visible ranges. */
    move(shares) {
      this.set(this.range.map(([a, b], k) => [a + shares[k] * (b - a), b + shares[k] * (b - a)]));
    }

    all() {
      this.set(this.whole);
    }
  }

  /* Mouse, wheel and fingers on one plot. */
  const listen = (plot, visible, vertical) => {
    const over = plot.over, fingers = new Map();
    over.style.touchAction = "pan-y";
    const place = (x, y) => {
      const box = over.getBoundingClientRect();
      return [(x - box.left) / box.width, 1 - (y - box.top) / box.height];
    };
    const both = ([x, y]) => (vertical ? [x, y] : [x]);
    over.addEventListener("wheel", (e) => {
      if (e.ctrlKey || e.metaKey) {
        e.preventDefault();
        const turned = Math.max(-60, Math.min(60, e.deltaY));
        visible.zoom(Math.exp(-0.01 * turned), both(place(e.clientX, e.clientY)));
      } else if (Math.abs(e.deltaX) > Math.abs(e.deltaY)) {
        e.preventDefault();
        visible.move(both([e.deltaX / over.clientWidth, 0]));
      }
    }, { passive: false });
    const spread = () => {
      const at = [...fingers.values()];
      const middle = [0, 1].map((k) => at.reduce((sum, p) => sum + p[k], 0) / at.length);
      const apart = at.length < 2 ? 0 : Math.hypot(at[0][0] - at[1][0], at[0][1] - at[1][1]);
      return { middle, apart: Math.max(apart, FINGER_MARGIN) };
    };
    const moves = (e) => e.pointerType !== "mouse" || e.shiftKey;
    over.addEventListener("pointerdown", (e) => {
      if (!moves(e)) return;
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
      over.setPointerCapture(e.pointerId);
    });
    over.addEventListener("pointermove", (e) => {
      if (!fingers.has(e.pointerId)) return;
      const before = spread();
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
      const after = spread();
      const shift = [
        (before.middle[0] - after.middle[0]) / over.clientWidth,
        (after.middle[1] - before.middle[1]) / over.clientHeight,
      ];
      visible.move(both(shift));
      if (fingers.size > 1) visible.zoom(after.apart / before.apart, both(place(...after.middle)));
    });
    for (const end of ["pointerup", "pointercancel"]) {
      over.addEventListener(end, (e) => fingers.delete(e.pointerId));
    }
  };

  const keys = (box, visible, vertical) => {
    const both = (x, y) => (vertical ? [x, y] : [x]);
    const actions = {
      ArrowLeft: () => visible.move(both(-STEP, 0)),
      ArrowRight: () => visible.move(both(STEP, 0)),
      "+": () => visible.zoom(FACTOR),
      "=": () => visible.zoom(FACTOR),
      "-": () => visible.zoom(1 / FACTOR),
      0: () => visible.all(),
      Home: () => visible.all(),
    };
    if (vertical) {
      actions.ArrowUp = () => visible.move([0, STEP]);
      actions.ArrowDown = () => visible.move([0, -STEP]);
    }
    box.addEventListener("keydown", (e) => {
      if (e.ctrlKey || e.metaKey || e.altKey || !(e.key in actions)) return;
      e.preventDefault();
      actions[e.key]();
    });
  };

  const bar = (figure, box, visible, stretches) => {
    const tools = element("div", "tools");
    const button = (text, says, action) => {
      const made = element("button", "", text);
      made.type = "button";
      made.title = says;
      made.setAttribute("aria-label", says);
      made.addEventListener("click", action);
      tools.append(made);
      return made;
    };
    button("All", "Show all (key 0)", () => visible.all());
    for (const stretch of stretches) {
      button(stretch.label, stretch.label, () => visible.set([[stretch.from, stretch.to]]));
    }
    button("−", "Show more (key −)", () => visible.zoom(1 / FACTOR));
    button("+", "Show less, larger (key +)", () => visible.zoom(FACTOR));
    const still = button("Still picture", "Show the still picture, as in print", () => {
      const on = figure.classList.toggle("zoomed");
      box.hidden = !on;
      still.setAttribute("aria-pressed", String(!on));
    });
    still.setAttribute("aria-pressed", "false");
    figure.insertBefore(tools, figure.firstChild);
  };

  /* Options that all plots share. */
  const options = (given) => ({
    width: 600,
    ...given,
    cursor: {
      drag: { x: true, y: given.vertical, uni: 20, setScale: false },
      points: { size: 5 },
      bind: {
        mousedown: (u, target, handler) => (e) => {
          if (e.button === 0 && !e.shiftKey) handler(e);
        },
        dblclick: () => () => given.visible.all(),
      },
      ...given.cursor,
    },
  });

  const axis = (given) => ({ font: FONT, labelFont: FONT, stroke: MUTED, labelSize: 18,
    grid: { stroke: GRID, width: 1 }, ticks: { stroke: GRID, width: 1, size: 4 }, gap: 4, ...given });

  const fitted = (box, resize) => {
    let last = 0;
    const check = () => {
      const width = Math.floor(box.clientWidth);
      if (width > 0 && width !== last) {
        last = width;
        resize(width);
      }
    };
    new ResizeObserver(check).observe(box);
    check();
  };

  /* Lines over time in panels one below the other, with one time axis. */
  const lines = (figure, box, data, id) => {
    const count = data.x.count, x = Array.from({ length: count }, (_, k) => data.x.start + k * data.x.step);
    const visible = new Visible([[x[0], x[count - 1]]], [Math.min(8 * data.x.step, x[count - 1] - x[0])]);
    bar(figure, box, visible, data.stretches);
    const plots = data.panels.map((panel, index) => {
      const last = index === data.panels.length - 1;
      const values = panel.lines.map((line) =>
        Array.from(numbers(line.values), (v) => (Number.isFinite(v) ? v : null)));
      const range = (u, low, high) => {
        if (low == null) return [-1, 1];
        const [least, most] = panel.limits || [low, high];
        const outside = low > most || high < least;
        const kept = outside ? [least, most] : [Math.max(low, least), Math.min(high, most)];
        return uPlot.rangeNum(kept[0], kept[1], 0.06, false);
      };
      const under = (u) => {
        const { left, top, width, height } = u.bbox, ctx = u.ctx;
        ctx.save();
        ctx.beginPath();
        ctx.rect(left, top, width, height);
        ctx.clip();
        ctx.fillStyle = STRETCH;
        for (const stretch of data.stretches) {
          const from = u.valToPos(stretch.from, "x", true);
          ctx.fillRect(from, top, u.valToPos(stretch.to, "x", true) - from, height);
        }
        if (panel.band) {
          const high = u.valToPos(panel.band, "y", true);
          ctx.fillStyle = BAND;
          ctx.fillRect(left, high, width, u.valToPos(-panel.band, "y", true) - high);
        }
        const [a, b] = visible.range[0], marks = data.marks.filter((t) => t >= a && t <= b);
        if (marks.length <= 40) {
          ctx.fillStyle = GRID;
          for (const t of marks) ctx.fillRect(Math.round(u.valToPos(t, "x", true)), top, devicePixelRatio, height);
        }
        ctx.restore();
      };
      const plot = new uPlot(options({
        height: panel.height + (last ? 40 : 0),
        visible,
        vertical: false,
        padding: [10, 8, 0, 0],
        scales: { x: { time: false }, y: { range } },
        cursor: {
          sync: { key: id, filters: { pub: (type) => type === "mousemove" || type === "mouseleave" } },
          y: false,
        },
        axes: [
          axis(last ? { label: data.x.label, size: 28 } : { size: 6, values: (u, splits) => splits.map(() => "") }),
          axis({ label: panel.label, size: 52, space: 26 }),
        ],
        series: [
          { label: data.x.label, value: (u, v) => (v == null ? "–" : String(Number(v.toFixed(4)))) },
          ...panel.lines.map((line) => ({
            label: line.label,
            stroke: line.colour,
            width: line.width,
            dash: line.dash,
            points: { show: false },
            value: (u, v) => written(v),
          })),
        ],
        hooks: {
          drawClear: [under],
          setSelect: [(u) => {
            if (u.select.width < 4) return;
            const at = [u.select.left, u.select.left + u.select.width].map((p) => u.posToVal(p, "x"));
            u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
            visible.set([at]);
          }],
        },
      }), [x, ...values], box);
      listen(plot, visible, false);
      return plot;
    });
    visible.changed = () => {
      const [min, max] = visible.range[0];
      for (const plot of plots) plot.setScale("x", { min, max });
    };
    keys(box, visible, false);
    fitted(box, (width) => plots.forEach((p, k) =>
      p.setSize({ width, height: data.panels[k].height + (k === plots.length - 1 ? 40 : 0) })));
    return { visible, plots };
  };

  /* Means of samples in cells of the visible part of a plane; zooming counts the samples again. */
  const counted = (data, panel, range) => {
    const n = data.cells, sums = new Float64Array(n * n), counts = new Uint32Array(n * n);
    const [[x0, x1], [y0, y1]] = range;
    for (let k = 0; k < panel.data.length; k++) {
      const v = panel.data[k], i = Math.floor((n * (data.x.data[k] - x0)) / (x1 - x0));
      const j = Math.floor((n * (data.y.data[k] - y0)) / (y1 - y0));
      if (!Number.isFinite(v) || i < 0 || j < 0 || i >= n || j >= n) continue;
      sums[j * n + i] += panel.squared ? v * v : v;
      counts[j * n + i] += 1;
    }
    const value = (c) => (panel.squared ? Math.sqrt(sums[c] / counts[c]) : sums[c] / counts[c]);
    return { counts, value };
  };

  const maps = (figure, box, data) => {
    for (const part of [data.x, data.y, ...data.panels]) part.data = numbers(part.values);
    const whole = [data.x.range, data.y.range];
    const visible = new Visible(whole, whole.map(([a, b]) => (b - a) / 40));
    bar(figure, box, visible, []);
    box.classList.add("maps");
    const plots = data.panels.map((panel) => {
      const cell = element("div", "map"), says = element("p", "says", "\u00a0");
      cell.append(element("p", "title", panel.title));
      let cells = null, shown = "";
      const current = () => {
        const key = visible.range.join();
        if (key !== shown) {
          shown = key;
          cells = counted(data, panel, visible.range);
        }
        return cells;
      };
      const colour = (v) => {
        const [low, high] = panel.limits, many = panel.colours.length;
        const k = Math.floor((many * (v - low)) / (high - low));
        return panel.colours[Math.max(0, Math.min(many - 1, k))];
      };
      const draw = (u) => {
        const { counts, value } = current(), { left, top, width, height } = u.bbox, n = data.cells, ctx = u.ctx;
        ctx.save();
        ctx.fillStyle = BLANK;
        ctx.fillRect(left, top, width, height);
        for (let j = 0; j < n; j++) {
          for (let i = 0; i < n; i++) {
            if (counts[j * n + i] < data.least) continue;
            const a = Math.round((width * i) / n), b = Math.round((width * (i + 1)) / n);
            const c = Math.round((height * (n - 1 - j)) / n), d = Math.round((height * (n - j)) / n);
            ctx.fillStyle = colour(value(j * n + i));
            ctx.fillRect(left + a, top + c, b - a, d - c);
          }
        }
        ctx.restore();
      };
      const plot = new uPlot(options({
        height: 250,
        visible,
        vertical: true,
        padding: [4, 8, 0, 0],
        legend: { show: false },
        scales: {
          x: { time: false, auto: false, range: () => visible.range[0] },
          y: { auto: false, range: () => visible.range[1] },
        },
        axes: [
          axis({ label: data.x.label, size: 28, grid: { show: false } }),
          axis({ label: data.y.label, size: 44, grid: { show: false } }),
        ],
        series: [{}, { paths: () => null, points: { show: false } }],
        hooks: {
          drawClear: [draw],
          setSelect: [(u) => {
            const { left, top, width, height } = u.select;
            if (width < 4 && height < 4) return;
            const range = [
              width < 4 ? visible.range[0] : [u.posToVal(left, "x"), u.posToVal(left + width, "x")],
              height < 4 ? visible.range[1] : [u.posToVal(top + height, "y"), u.posToVal(top, "y")],
            ];
            u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
            visible.set(range);
          }],
          setCursor: [(u) => {
            const n = data.cells, { left, top } = u.cursor;
            const i = Math.floor((n * left) / u.over.clientWidth);
            const j = Math.floor(n * (1 - top / u.over.clientHeight));
            const c = j * n + i, inside = left >= 0 && i < n && j >= 0 && j < n;
            if (!inside) says.textContent = "\u00a0";
            else if (current().counts[c] < data.least) says.textContent = "hardly ever here";
            else says.textContent = `${written(current().value(c))} ${panel.unit}, ${current().counts[c]} samples`;
          }],
        },
      }), [visible.range[0], [null, null]], cell);
      const legend = element("div", "bar"), ramp = element("span", "ramp");
      ramp.style.background = `linear-gradient(to right, ${panel.colours.join(", ")})`;
      legend.append(element("span", "", written(panel.limits[0])), ramp,
        element("span", "", `${written(panel.limits[1])} ${panel.unit}`));
      cell.append(legend, says);
      box.append(cell);
      listen(plot, visible, true);
      fitted(cell, (width) => plot.setSize({ width, height: 250 }));
      return plot;
    });
    visible.changed = () => {
      const [x, y] = visible.range;
      for (const plot of plots) {
        plot.batch(() => {
          plot.setScale("x", { min: x[0], max: x[1] });
          plot.setScale("y", { min: y[0], max: y[1] });
        });
      }
    };
    keys(box, visible, true);
    return { visible, plots };
  };

  document.querySelectorAll("figure.zoomable").forEach((figure, index) => {
    const data = JSON.parse(figure.querySelector("script").textContent);
    const box = element("div", "zoom"), picture = figure.querySelector("img");
    box.tabIndex = 0;
    box.setAttribute("role", "group");
    box.setAttribute("aria-label", `${picture.alt} Arrow keys move, plus and minus zoom, 0 shows all.`);
    figure.classList.add("zoomed");
    picture.before(box);
    figure.zoom = (data.kind === "map" ? maps : lines)(figure, box, data, `zoom-${index}`);
    const help = "Drag to zoom, shift and drag to move, double click for all; keys: arrows, + − 0; wheel with Ctrl; "
      + "one finger moves, two zoom.";
    box.after(element("p", "help", `${data.note} ${help}`.trim()));
  });
})();
