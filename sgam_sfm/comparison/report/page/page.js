"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  const darkness = matchMedia("(prefers-color-scheme: dark)");
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const rgb = (name) => [1, 3, 5].map((start) => parseInt(colour(name).slice(start, start + 2), 16));
  const mixed = (from, to, share) => from.map((value, channel) => Math.round(value + (to[channel] - value) * share));
  // Names come from files: plotly reads a little HTML in its texts.
  const escaped = (text) => text.replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");
  const methodName = (number) => (number === null ? "ground truth" : escaped(data.methods[number]));
  const pairName = ([a, b]) => escaped(`${data.names[a]} - ${data.names[b]}`);

  // The reference is grey, others have the colours 1..8 in their order; marks and dashes tell them apart without hue.
  const own = (number) => (number === null ? "ink" : number === data.reference ? "m0" : `m${(number % 8) + 1}`);
  const dashes = ["solid", "longdash", "dot", "dashdot"];
  const marks = ["circle", "diamond", "square", "cross", "triangle-up", "x"];
  const dashOf = (number) => (number === data.reference ? "dash" : dashes[number % dashes.length]);

  // --- plots ---

  const narrow = () => innerWidth < 600;
  const axis = (title, more = {}) => ({
    title: { text: title, standoff: 8 }, gridcolor: colour("rule"), zeroline: false, linecolor: colour("rule"),
    automargin: true, tickfont: { color: colour("muted") }, ...more,
  });
  const layout = (more) => ({
    font: { family: "system-ui, sans-serif", size: 13, color: colour("ink") },
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", margin: { l: 8, r: 12, t: 8, b: 8 },
    legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom", font: { size: narrow() ? 11 : 13 } },
    hoverlabel: { bgcolor: colour("panel"), bordercolor: colour("rule"), font: { color: colour("ink") }, align: "left" },
    ...more,
  });
  const line = (trace, more = {}) => ({
    type: "scatter", mode: "lines", name: methodName(trace.method), x: trace.x, y: trace.y,
    line: { color: colour(own(trace.method)), width: 2, dash: dashOf(trace.method) }, ...more,
  });
  // Counts are whole: no axis has a tick between two of them.
  const countAxis = (title, traces, more = {}) => {
    const counts = traces.flatMap((trace) => trace.x);
    return axis(title, { ...(Math.max(...counts) - Math.min(...counts) <= 10 ? { dtick: 1 } : {}), tickformat: ",d", ...more });
  };
  const logCountAxis = (title, traces) => {
    const counts = traces.flatMap((trace) => trace.y);
    const [low, high] = [0.7 * Math.min(...counts), 1.5 * Math.max(...counts)];
    const decades = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9].map((power) => 10 ** power);
    const ticks = (high / low > 1000 ? [1] : [1, 2, 5]).flatMap((digit) => decades.map((decade) => digit * decade));
    return axis(title, {
      type: "log", range: [Math.log10(low), Math.log10(high)], tickvals: ticks, ticktext: ticks.map((tick) => tick.toLocaleString("en")),
    });
  };
  const degrees = [0.01, 0.1, 1, 10, 180];
  const degreeAxis = (title, traces, of, ticks) => axis(title, {
    type: "log", range: [-2, Math.log10(Math.min(200, 1.4 * Math.max(5, ...traces.flatMap((trace) => trace[of]))))],
    tickvals: ticks, ticktext: ticks.map((d) => `${d}°`),
  });

  const scattered = (traces, title, unit) => ({
    traces: traces.flatMap((trace) => {
      const look = { color: colour(own(trace.method)), symbol: marks[trace.method % marks.length] };
      return [
        {
          type: "scatter", mode: "markers", name: methodName(trace.method), legendgroup: `${trace.method}`,
          x: trace.x, y: trace.y, cliponaxis: false, text: trace.pairs.map(pairName), marker: { ...look, size: 6, opacity: 0.6 },
          hovertemplate: `%{text}<br>%{x:.3g}${unit}, error %{y:.3g}°<extra>%{fullData.name}</extra>`,
        },
        {
          type: "scatter", mode: "lines", legendgroup: `${trace.method}`, showlegend: false, hoverinfo: "skip",
          x: trace.median.map((m) => m[0]), y: trace.median.map((m) => m[1]),
          line: { color: look.color, width: 2, dash: dashOf(trace.method) },
        },
      ];
    }),
    layout: { xaxis: axis(title, { ticksuffix: unit }), yaxis: degreeAxis("pose error, degrees", traces, "y", degrees) },
  });

  const edges = [0, 1, 2, 0, 3, 4, 0, null, 1, 2, 3, 4, 1, null];
  const wires = (cameras, part) => cameras.flatMap((corners) => edges.map((e) => (e === null ? null : corners[e][part])));
  const model = (trace) => {
    const tint = colour(own(trace.method));
    const common = { type: "scatter3d", legendgroup: `${trace.method}` };
    const [x, y, z] = trace.points;
    const wired = [
      {
        ...common, mode: "lines", name: methodName(trace.method), line: { color: tint, width: trace.method === null ? 4 : 3 },
        x: wires(trace.cameras, 0), y: wires(trace.cameras, 1), z: wires(trace.cameras, 2), hoverinfo: "text",
        text: trace.names.flatMap((name) => edges.map(() => escaped(name))),
      },
    ];
    const dots = {
      ...common, mode: "markers", showlegend: false, hoverinfo: "skip", x, y, z,
      marker: { color: tint, size: 1.6, opacity: 0.7 },
    };
    return x.length ? [...wired, dots] : wired;
  };

  // Stages have an order: shades in that order, and their names where there is room, read without a legend.
  const stageColour = (index) => {
    const share = (index + 1) / (Object.keys(data.stages).length + 1);
    return `rgb(${mixed(rgb("from"), rgb("to"), share).join(",")})`;
  };

  const plots = {
    curves: () => ({
      traces: data.curves.map((trace) => line(trace, {
        line: { ...line(trace).line, shape: "hv" }, hovertemplate: "%{y:.1f} % of pairs within %{x:.3g}°<extra>%{fullData.name}</extra>",
      })),
      layout: {
        xaxis: degreeAxis("pose error, degrees", data.curves, "x", narrow() ? degrees : [0.01, 0.03, 0.1, 0.5, 1, 3, 5, 20, 60, 180]),
        yaxis: axis("share of pairs", { range: [0, 102], ticksuffix: " %" }),
      },
    }),
    by_angle: () => scattered(data.by_angle, "angle between views, degrees", "°"),
    by_scale: () => scattered(data.by_scale, "change of scale, times", "x"),
    coverage: () => ({
      traces: data.coverage.map((trace) => line(trace, {
        mode: trace.x.length < 60 ? "lines+markers" : "lines", text: trace.pairs.map(pairName),
        hovertemplate: "%{text}<br>%{y:.0f} % in kept areas<extra>%{fullData.name}</extra>",
      })),
      layout: { xaxis: countAxis("rank of the pair, most covered first", data.coverage), yaxis: axis("share in kept areas", { range: [0, 102], ticksuffix: " %" }), showlegend: true },
    }),
    stages: () => ({
      traces: Object.entries(data.stages).map(([stage, seconds], index) => ({
        type: "bar", orientation: "h", name: escaped(stage), y: data.methods.map((_, number) => number), x: seconds,
        marker: { color: stageColour(index), line: { color: colour("panel"), width: 1 } }, text: seconds.map(() => escaped(stage)),
        textposition: "inside", insidetextanchor: "middle", textangle: 0,
        hovertemplate: "%{x:.1f} s<extra>%{fullData.name}</extra>",
      })),
      layout: {
        barmode: "stack", bargap: 0.35, xaxis: axis("seconds"),
        uniformtext: { mode: "hide", minsize: 11 }, legend: { ...layout().legend, traceorder: "normal" },
        yaxis: axis("method", {
          autorange: "reversed", tickvals: data.methods.map((_, n) => n),
          ticktext: data.methods.map((_, n) => (narrow() ? methodName(n).replace(/[:@]/g, "$&<br>") : methodName(n))),
        }),
      },
    }),
    tracks: () => ({
      traces: data.tracks.map((trace) => line(trace, {
        mode: "lines+markers", marker: { size: 7, symbol: marks[trace.method % marks.length] },
        hovertemplate: "%{y:,} points seen by %{x} images<extra>%{fullData.name}</extra>",
      })),
      layout: { xaxis: countAxis("images that see a point", data.tracks), yaxis: logCountAxis("number of points", data.tracks) },
    }),
    scene: () => {
      const away = narrow() ? 1.35 : 1;
      const bare = { visible: false, showspikes: false };
      return {
        traces: data.scene.flatMap(model),
        layout: {
          margin: { l: 0, r: 0, t: 0, b: 0 }, uirevision: "kept",
          modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("muted"), activecolor: colour("accent"), orientation: "v" },
          legend: { orientation: "h", x: 0, y: 0, yanchor: "top", itemsizing: "constant", font: { size: narrow() ? 11 : 13 } },
          scene: {
            xaxis: bare, yaxis: bare, zaxis: bare, aspectmode: "data", dragmode: "turntable",
            camera: { eye: { x: -0.45 * away, y: -1.3 * away, z: 0.75 * away }, center: { x: 0, y: 0, z: -0.16 }, up: { x: 0, y: 0, z: 1 } },
          },
        },
      };
    },
  };

  const draw = (element) => {
    const plot = plots[element.id]();
    // Scrolling over the scene goes on scrolling the page: its buttons zoom.
    return Plotly.react(element, plot.traces, layout(plot.layout), {
      responsive: true, displaylogo: false, scrollZoom: false, displayModeBar: element.id === "scene",
      modeBarButtons: [["tableRotation", "pan3d", "zoom3d", "resetCameraDefault3d", "toImage"]],
    });
  };
  byId("stages").style.height = `${130 + 52 * data.methods.length + (narrow() ? 70 : 0)}px`;
  const drawn = new Set();
  const watch = new IntersectionObserver((entries) => {
    for (const { target } of entries.filter((entry) => entry.isIntersecting)) {
      watch.unobserve(target);
      drawn.add(target);
      draw(target);
    }
  }, { rootMargin: "800px" });
  document.querySelectorAll(".plot").forEach((element) => watch.observe(element));

  // --- matrices ---

  const { bins, cells, counts, matches, inliers } = data.matrices;
  const at = new Map(cells.flatMap(([i, j], cell) => [[i * bins.length + j, cell], [j * bins.length + i, cell]]));
  const values = () => {
    const kind = document.querySelector("input[name=matrix]:checked").value;
    const change = inliers.map((of) => of.map((value, cell) => value - inliers[data.reference][cell]));
    return { kind, of: { matches, inliers, change }[kind] };
  };

  const paint = () => {
    const { kind, of } = values();
    const most = of.flat().reduce((largest, value) => Math.max(largest, Math.abs(value)), 1);
    const [from, to, minus, zero, plus] = ["from", "to", "minus", "zero", "plus"].map(rgb);
    // The root shows differences among small numbers, where pairs are won and lost.
    const share = (value) => Math.sqrt(Math.abs(value) / most);
    const shade = (value) => (kind === "change" ? mixed(zero, value < 0 ? minus : plus, share(value)) : mixed(from, to, share(value)));
    document.querySelectorAll(".matrices canvas").forEach((canvas, number) => {
      const context = canvas.getContext("2d");
      const pixels = context.createImageData(bins.length, bins.length);
      at.forEach((cell, place) => pixels.data.set([...shade(of[number][cell]), 255], 4 * place));
      context.putImageData(pixels, 0, 0);
    });
    const [low, bar, high] = byId("scale").children;
    low.textContent = kind === "change" ? `${-most} inliers lost` : "0";
    high.textContent = kind === "change" ? `+${most} inliers gained` : `${most} ${kind === "matches" ? "raw matches" : "inliers"}`;
    const stops = kind === "change" ? ["minus", "zero", "plus"] : ["from", "to"];
    bar.style.background = `linear-gradient(90deg, ${stops.map(colour).join(", ")})`;
  };

  const tip = byId("tip");
  const paragraph = (text) => Object.assign(document.createElement("p"), { textContent: text });
  const binName = ([first, last]) => (first === last ? data.names[first] : `${data.names[first]} … ${data.names[last]}`);
  const thumbnail = ([first, last]) => {
    for (let number = first; number <= last; number += 1) if (data.thumbnails[number]) return [number, data.thumbnails[number]];
    return null;
  };
  const showTip = (number, row, column, x, y) => {
    const cell = at.get(row * bins.length + column);
    if (cell === undefined) return hideTip();
    const images = document.createElement("div");
    images.className = "images";
    for (const bin of [bins[row], bins[column]]) {
      const found = thumbnail(bin);
      if (found) images.append(Object.assign(new Image(), { src: found[1], alt: data.names[found[0]] }));
    }
    const change = inliers[number][cell] - inliers[data.reference][cell];
    const several = counts[cell] > 1 ? `, mean of ${counts[cell]} pairs` : "";
    const against = number === data.reference ? "" : `, ${change > 0 ? "gained +" : change < 0 ? "lost " : "equal "}${Math.round(change * 10) / 10}`;
    tip.replaceChildren(
      images,
      paragraph(`${binName(bins[row])} - ${binName(bins[column])}`),
      paragraph(`${inliers[number][cell]} inliers of ${matches[number][cell]} raw matches${against}${several}`),
    );
    tip.hidden = false;
    const box = tip.getBoundingClientRect();
    tip.style.left = `${Math.max(8, Math.min(x + 16, innerWidth - box.width - 8))}px`;
    tip.style.top = `${y + 20 + box.height < innerHeight ? y + 20 : Math.max(8, y - box.height - 12)}px`;
    return undefined;
  };
  const hideTip = () => { tip.hidden = true; };

  const addMatrix = (name, number) => {
    const figure = document.createElement("figure");
    figure.style.setProperty("--own", `var(--${own(number)})`);
    const caption = Object.assign(document.createElement("figcaption"), { textContent: name });
    const canvas = Object.assign(document.createElement("canvas"), { width: bins.length, height: bins.length, tabIndex: 0 });
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `Matches of every pair by ${name}; arrow keys move from cell to cell`);
    let [row, column] = cells[0] ?? [0, 0];
    const cellAt = (event) => {
      const box = canvas.getBoundingClientRect();
      const index = (offset, length) => Math.max(0, Math.min(bins.length - 1, Math.floor((offset / length) * bins.length)));
      return [index(event.clientY - box.top, box.height), index(event.clientX - box.left, box.width)];
    };
    const pointed = (event) => {
      [row, column] = cellAt(event);
      showTip(number, row, column, event.clientX, event.clientY);
    };
    canvas.addEventListener("pointermove", pointed);
    canvas.addEventListener("pointerdown", pointed);
    canvas.addEventListener("pointerleave", hideTip);
    canvas.addEventListener("blur", hideTip);
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key];
      if (event.key === "Escape") hideTip();
      if (!step) return;
      event.preventDefault();
      [row, column] = [row + step[0], column + step[1]].map((value) => Math.max(0, Math.min(bins.length - 1, value)));
      const box = canvas.getBoundingClientRect();
      const middle = (index, length) => ((index + 0.5) / bins.length) * length;
      showTip(number, row, column, box.left + middle(column, box.width), box.top + middle(row, box.height));
    });
    figure.append(caption, canvas);
    byId("matrices").append(figure);
  };
  data.methods.forEach(addMatrix);
  document.querySelectorAll("input[name=matrix]").forEach((input) => input.addEventListener("change", paint));
  paint();
  darkness.addEventListener("change", () => { paint(); drawn.forEach(draw); });

  // --- gallery ---

  const large = byId("large");
  document.querySelectorAll(".gallery .open").forEach((button) => button.addEventListener("click", () => {
    const { src, alt } = button.querySelector("img");
    Object.assign(large.querySelector("img"), { src, alt });
    large.showModal();
    large.scrollTop = 0;
  }));
  large.addEventListener("click", () => large.close());
})();
