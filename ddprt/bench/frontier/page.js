"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const errorChoice = document.getElementById("error-choice");
  const tip = document.getElementById("tip");
  const chosen = new Set();
  const rows = new Map(data.settings.map((setting) => [setting.digest, document.getElementById(setting.digest)]));
  const indexOf = new Map(data.settings.map((setting, index) => [setting.digest, index]));
  const plots = [...document.querySelectorAll(".plot")].map((figure) => ({
    figure,
    title: figure.querySelector(".error-title"),
    canvas: figure.querySelector(".canvas"),
    choice: figure.querySelector("select"),
    words: figure.querySelector(".words"),
    left: figure.querySelector(".left-out"),
  }));
  let pinned = -1;

  const make = (name, attributes, parent, text) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (text !== undefined) node.textContent = text;
    if (parent) parent.append(node);
    return node;
  };
  const round = (value) => value.toFixed(1);
  const outline = (marker, x, y, radius) =>
    marker.outline.map(([across, up]) => `${round(x + radius * across)},${round(y - radius * up)}`).join(" ");
  const faded = (setting) => chosen.size > 0 && setting.knobs.length > 0 && !setting.knobs.some((knob) => chosen.has(knob));

  const overlap = (a, b) => a.x0 < b.x1 && b.x0 < a.x1 && a.y0 < b.y1 && b.y0 < a.y1;
  const about = (x, y, radius) => ({ x0: x - radius, x1: x + radius, y0: y - radius, y1: y + radius });
  const boxOf = (node, space) => {
    const box = node.getBBox();
    return { x0: box.x - space, x1: box.x + box.width + space, y0: box.y - space, y1: box.y + box.height + space };
  };

  // Middle first, then the middles of the halves: what is named first stands apart.
  const spaced = (list) => {
    if (!list.length) return [];
    const middle = list.length >> 1;
    const sides = [spaced(list.slice(0, middle)), spaced(list.slice(middle + 1))];
    const mixed = [];
    for (let i = 0; i < Math.max(sides[0].length, sides[1].length); i++)
      for (const side of sides) if (i < side.length) mixed.push(side[i]);
    return [list[middle], ...mixed];
  };

  const tell = (index, x, y) => {
    const setting = data.settings[index];
    tip.replaceChildren();
    const head = document.createElement("strong");
    head.textContent = setting.name;
    const list = document.createElement("dl");
    for (const [axes, values] of [[data.errors, setting.errors], [data.costs, setting.costs]])
      axes.forEach((axis, at) => {
        if (!values[at]) return;
        const term = document.createElement("dt");
        const text = document.createElement("dd");
        term.textContent = axis.title;
        text.textContent = values[at][1];
        list.append(term, text);
      });
    tip.append(head, list);
    tip.hidden = false;
    const wide = document.documentElement.clientWidth;
    const high = window.innerHeight;
    const box = tip.getBoundingClientRect();
    tip.style.left = `${Math.max(8, Math.min(x + 16, wide - box.width - 8))}px`;
    tip.style.top = `${y + 20 + box.height < high ? y + 20 : Math.max(8, y - box.height - 16)}px`;
  };
  const mark = (index, name, on) => {
    for (const plot of plots)
      for (const node of plot.canvas.querySelectorAll(`[data-index="${index}"]`)) node.classList.toggle(name, on);
    rows.get(data.settings[index].digest).classList.toggle(name, on);
  };
  const point = (index, x, y) => {
    mark(index, "pointed", true);
    if (x !== undefined) tell(index, x, y);
  };
  const leave = (index) => {
    mark(index, "pointed", false);
    tip.hidden = true;
  };
  const pin = () => {
    if (pinned >= 0) mark(pinned, "pinned", false);
    const found = indexOf.get(decodeURIComponent(location.hash.slice(1)));
    pinned = found === undefined ? -1 : found;
    if (pinned >= 0) mark(pinned, "pinned", true);
  };

  const draw = (plot) => {
    const across = data.costs.findIndex((axis) => axis.key === plot.choice.value);
    const up = data.errors.findIndex((axis) => axis.key === errorChoice.value);
    const [x, y] = [data.costs[across], data.errors[up]];
    plot.title.textContent = y.title;
    const pair = data.pairs[`${y.key}/${x.key}`];
    const width = plot.canvas.clientWidth;
    const height = Math.round(Math.min(400, Math.max(270, 0.68 * width)));
    const frame = { left: 58, right: width - 10, top: 10, bottom: height - 42 };
    const scale = (axis, from, to) => (value) => from + ((to - from) * Math.log(value / axis.low)) / Math.log(axis.high / axis.low);
    const atX = scale(x, frame.left, frame.right);
    const atY = scale(y, frame.bottom, frame.top);
    const svg = make("svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "img", "aria-label": `${y.title} against ${x.title}` });
    plot.canvas.replaceChildren(svg);

    let end = -Infinity;
    for (const [value, text] of x.ticks) {
      make("line", { class: "grid", x1: atX(value), x2: atX(value), y1: frame.top, y2: frame.bottom }, svg);
      const node = make("text", { class: "tick", x: atX(value), y: frame.bottom + 16, "text-anchor": "middle" }, svg, text);
      const box = boxOf(node, 3);
      if (box.x0 < end || box.x1 > width + 3) node.remove();
      else end = box.x1;
    }
    for (const [value, text] of y.ticks) {
      make("line", { class: "grid", x1: frame.left, x2: frame.right, y1: atY(value), y2: atY(value) }, svg);
      make("text", { class: "tick", x: frame.left - 6, y: atY(value) + 4, "text-anchor": "end" }, svg, text);
    }
    make("path", { class: "frame", d: `M${frame.left},${frame.top}V${frame.bottom}H${frame.right}` }, svg);
    make("text", { class: "title", x: (frame.left + frame.right) / 2, y: height - 6, "text-anchor": "middle" }, svg, x.title);

    const floors = y.key === "error" ? data.floors : [];
    for (const [, level] of floors) make("line", { class: "floor", x1: frame.left, x2: frame.right, y1: atY(level), y2: atY(level) }, svg);
    const [taken, words] = [[], []];
    const places = data.settings.map((setting) => {
      const [cost, error] = [setting.costs[across], setting.errors[up]];
      return cost && error && cost[0] > 0 && error[0] > 0 ? [atX(cost[0]), atY(error[0])] : null;
    });
    const without = places.filter((place) => !place).length;
    plot.left.textContent = without ? `${without} of ${places.length} settings have none of one of the two (no value, or zero) and are not drawn.` : "";

    if (pair.path.length) {
      let d = `M${round(places[pair.path[0]][0])},${frame.top}`;
      let [fromX, fromY] = [places[pair.path[0]][0], frame.top];
      for (const index of pair.path) {
        const [toX, toY] = places[index];
        d += `H${round(toX)}V${round(toY)}`;
        taken.push({ x0: fromX, x1: toX, y0: fromY - 1, y1: fromY + 1 }, { x0: toX - 1, x1: toX + 1, y0: fromY, y1: toY });
        [fromX, fromY] = [toX, toY];
      }
      taken.push({ x0: fromX, x1: frame.right, y0: fromY - 1, y1: fromY + 1 });
      make("path", { class: "front", d: `${d}H${frame.right}` }, svg);
    }
    const onFront = new Set(pair.front);
    const order = places.map((_, index) => index).filter((index) => places[index]);
    const rank = (index) => (onFront.has(index) ? 2 : index === data.base ? 1 : 0);
    const layer = (index) => (index === data.base ? 3 : rank(index));
    order.sort((a, b) => layer(a) - layer(b));
    for (const index of order) {
      const setting = data.settings[index];
      const marker = data.markers[setting.kind];
      const [px, py] = places[index];
      const best = rank(index) > 0;
      const gone = faded(setting);
      const link = make("a", { href: `#${setting.digest}`, "data-index": index, class: `${["beaten", "base", "best"][rank(index)]}${gone ? " faded" : ""}` }, svg);
      if (!best || gone) link.setAttribute("tabindex", "-1");
      link.style.setProperty("--own", marker.colour === "#24292f" ? "var(--plot-ink)" : marker.colour);
      link.setAttribute("aria-label", `${setting.name}: ${setting.errors[up][1]}, ${setting.costs[across][1]}`);
      make("circle", { class: "target", cx: px, cy: py, r: 9 }, link);
      const [, , low, high] = setting.costs[across];
      if (low > 0 && high > low) {
        make("line", { class: "spread", x1: atX(low), x2: atX(high), y1: py, y2: py }, link);
        taken.push({ x0: atX(low), x1: atX(high), y0: py - 1, y1: py + 1 });
      }
      make("polygon", { points: outline(marker, px, py, best ? 6.5 : 4.5) }, link);
      make("circle", { class: "halo", cx: px, cy: py, r: 10 }, link);
      taken.push(about(px, py, best ? 6 : 4));
      link.addEventListener("pointerenter", (event) => point(index, event.clientX, event.clientY));
      link.addEventListener("pointerleave", () => leave(index));
      link.addEventListener("focus", () => {
        const box = link.getBoundingClientRect();
        if (link.matches(":focus-visible")) point(index, box.right, box.bottom);
      });
      link.addEventListener("blur", () => leave(index));
    }
    if (pair.knee !== null) {
      const [px, py] = places[pair.knee];
      make("circle", { class: "knee", cx: px, cy: py, r: 11 }, svg);
      taken.push(about(px, py, 11));
    }

    for (const [text, level] of floors) {
      const node = make("text", { class: "floor" }, svg, text);
      const ways = [[frame.right - 2, "end"], [frame.left + 4, "start"], [(frame.left + frame.right) / 2, "middle"]];
      let [fewest, least] = [null, Infinity];
      for (const [at, anchor] of ways)
        for (const sink of [-4, 12]) {
          for (const [key, value] of [["x", at], ["y", atY(level) + sink], ["text-anchor", anchor]]) node.setAttribute(key, value);
          const box = boxOf(node, 1);
          const hidden = taken.filter((other) => overlap(box, other)).length;
          if (hidden < least) [fewest, least] = [{ at, anchor, sink, box }, hidden];
        }
      for (const [key, value] of [["x", fewest.at], ["y", atY(level) + fewest.sink], ["text-anchor", fewest.anchor]]) node.setAttribute(key, value);
      words.push(fewest.box);
      taken.push(fewest.box, { x0: frame.left, x1: frame.right, y0: atY(level) - 1, y1: atY(level) + 1 });
    }

    const shown = pair.path.filter((index) => !faded(data.settings[index]));
    const first = [pair.knee, shown[0], shown[shown.length - 1], ...spaced(shown)].filter((entry) => shown.includes(entry));
    if (data.base !== null && places[data.base]) first.splice(1, 0, data.base);
    let named = 0;
    for (const index of new Set(first)) {
      if (named >= (width < 420 ? 5 : 9)) break;
      const [px, py] = places[index];
      const knee = index === pair.knee;
      const node = make("text", { class: knee ? "label knee-label" : "label" }, svg);
      const far = knee ? 14 : 9;
      const near = 0.75 * far;
      const ways = [[near, -near, "start", 0], [-near, near, "end", 9], [far, 0, "start", 4], [-far, 0, "end", 4], [0, -far, "middle", 0], [0, far, "middle", 9], [-near, -near, "end", 0], [near, near, "start", 9]];
      const fitsAs = (text) => {
        node.textContent = text;
        return [1, 2.2, 3.6].some((reach) =>
          ways.some(([dx, dy, anchor, sink]) => {
            node.setAttribute("x", px + reach * dx);
            node.setAttribute("y", py + reach * dy + sink);
            node.setAttribute("text-anchor", anchor);
            const box = boxOf(node, 1.5);
            const inside = box.x0 >= frame.left && box.x1 <= width && box.y0 >= 0 && box.y1 <= frame.bottom;
            if (!inside || taken.some((other) => overlap(box, other))) return false;
            const line = reach > 1 ? [...Array(10).keys()].map((bit) => about(px + dx * (1 + ((reach - 1) * bit) / 9), py + dy * (1 + ((reach - 1) * bit) / 9), 0.5)) : [];
            if (line.some((bit) => words.some((other) => overlap(bit, other)))) return false;
            taken.push(box, ...line);
            words.push(box);
            if (reach > 1) make("line", { class: "leader", x1: px + dx, y1: py + dy, x2: px + reach * dx, y2: py + reach * dy }, svg);
            return true;
          })
        );
      };
      const name = data.settings[index].name;
      const fits = (knee ? [`knee: ${name}`, "knee"] : [name]).some(fitsAs);
      if (fits) named += 1;
      else node.remove();
    }

    plot.words.replaceChildren(
      ...pair.words.map((text) => {
        const item = document.createElement("li");
        item.textContent = text;
        return item;
      })
    );
  };
  const drawAll = () => {
    plots.forEach(draw);
    for (const setting of data.settings) rows.get(setting.digest).hidden = faded(setting);
    if (pinned >= 0) mark(pinned, "pinned", true);
  };

  for (const control of document.querySelectorAll(".controls")) control.hidden = false;
  errorChoice.addEventListener("change", drawAll);
  plots.forEach((plot) => plot.choice.addEventListener("change", drawAll));
  for (const chip of document.querySelectorAll("button.chip"))
    chip.addEventListener("click", () => {
      const knob = chip.dataset.knob;
      if (!chosen.delete(knob)) chosen.add(knob);
      chip.setAttribute("aria-pressed", String(chosen.has(knob)));
      drawAll();
    });
  for (const [digest, row] of rows) {
    row.addEventListener("pointerenter", () => point(indexOf.get(digest)));
    row.addEventListener("pointerleave", () => leave(indexOf.get(digest)));
  }
  const table = document.getElementById("settings-table");
  table?.querySelectorAll("thead button").forEach((button, column) =>
    button.addEventListener("click", () => {
      const head = button.closest("th");
      const down = head.getAttribute("aria-sort") === "ascending";
      table.querySelectorAll("thead th").forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const key = (body) => body.rows[0].cells[column].dataset.value;
      const sorted = [...table.tBodies].sort((a, b) => {
        const [p, q] = [key(a), key(b)];
        if (p === "" || q === "") return (p === "") - (q === "");
        const difference = column === 0 ? p.localeCompare(q, "en", { numeric: true }) : p - q;
        return down ? -difference : difference;
      });
      table.append(...sorted);
    })
  );
  window.addEventListener("hashchange", pin);
  new ResizeObserver(() => drawAll()).observe(document.querySelector(".plots"));
  drawAll();
  pin();
})();
