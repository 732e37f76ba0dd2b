"use strict";
(() => {
  const data = JSON.parse(document.getElementById("payload").textContent);
  const { truth, series, grasps, steps, paths, pictures } = data;
  const colours = { seen: "#0072b2", unseen: "#e69f00", held: "#f0e442", ink: "#1d2733", soft: "#5b6875", red: "#d55e00", green: "#009e73" };
  const font = { family: 'system-ui, "Segoe UI", Roboto, Arial, sans-serif', size: 12, color: colours.ink };
  const still = { displaylogo: false, responsive: true, displayModeBar: false };
  const config = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["lasso2d", "select2d", "autoScale2d", "toImage"] };
  const scales = { b: "Viridis", sd: "Cividis" };

  // ---- the sheet at rest -------------------------------------------------------------------------------------
  const [along, across] = data.axes;
  const border = truth && (() => {
    const x = [], y = [];
    for (const [a, b] of truth.outline) { x.push(a[0], b[0], null); y.push(a[1], b[1], null); }
    return (colour, width) => ({ type: "scatter", mode: "lines", x, y, line: { color: colour, width }, hoverinfo: "skip", showlegend: false });
  })();
  const range = (axis) => {
    const values = data.flat.map((p) => p[axis]).concat(truth ? truth.outline.flat().map((p) => p[axis]) : []);
    const low = Math.min(...values), high = Math.max(...values), room = 0.03 * (high - low) + 0.5;
    return [low - room, high + room];
  };
  const flatLayout = {
    height: 350, margin: { l: 46, r: 4, t: 4, b: 92 }, showlegend: false, font, paper_bgcolor: "#fff", plot_bgcolor: "#fff", hovermode: "closest",
    xaxis: { range: range(0), title: { text: `${along} [mm]`, standoff: 4 }, zeroline: false, gridcolor: "#eef1f4", constrain: "domain" },
    yaxis: { range: range(1), title: { text: `${across} [mm]`, standoff: 4 }, zeroline: false, gridcolor: "#eef1f4", scaleanchor: "x", constrain: "domain" },
  };
  const bar = (title) => ({ orientation: "h", x: 0.5, xanchor: "center", y: -0.2, yanchor: "top", thickness: 9, len: 0.96, outlinewidth: 0, title: { text: title, side: "bottom" }, nticks: 5 });
  const field = (id, grid, scale, top, title, unit = " N/m") => {
    const traces = [{ type: "heatmap", x: data.grids.x, y: data.grids.y, z: grid, colorscale: scale, zmin: 0, zmax: top, hoverongaps: false,
      colorbar: bar(title), hovertemplate: `${along} %{x:.1f}, ${across} %{y:.1f} mm<br>%{z:.3g}${unit}<extra></extra>` }];
    if (border) traces.push(border("#1d2733", 3.2), border("#ffffff", 1.4));
    Plotly.newPlot(id, traces, flatLayout, still);
  };
  field("map-mean", data.grids.mean, scales.b, data.top_b, "mean b [N/m]");
  field("map-sd", data.grids.sd, scales.sd, data.top_sd, "sd of b [N/m]");
  if (data.grids.probability) field("map-probability", data.grids.probability, scales.b, 1, "P(attached)", "");
  if (truth) field("map-truth", data.grids.truth, scales.b, data.top_b, "b* [N/m]");

  const kinds = truth
    ? [["free", (d, t) => !d && !t, { color: "#d3dae1", size: 3.5, symbol: "circle" }],
       ["correct", (d, t) => d && t, { color: colours.seen, size: 7, symbol: "circle" }],
       ["missed", (d, t) => !d && t, { color: colours.red, size: 7, symbol: "circle-open", line: { width: 2 } }],
       ["false", (d, t) => d && !t, { color: colours.red, size: 7.5, symbol: "x" }]]
    : [["not reported", (d) => !d, { color: "#d3dae1", size: 3.5, symbol: "circle" }],
       ["reported", (d) => d, { color: colours.seen, size: 7, symbol: "circle" }]];
  const dots = kinds.map(([name, belongs, marker]) => {
    const chosen = data.flat.map((_, i) => i).filter((i) => belongs(data.detected[i], truth && truth.attached[i]));
    const within = (i) => (data.interval ? `<br>90 %: ${data.interval[0][i]} to ${data.interval[1][i] ?? "∞"} N/m` : "");
    const star = (i) => (truth.welded[i] ? "weld" : truth.stiffness[i] === null ? "unknown" : `${truth.stiffness[i]} N/m`);
    return { type: "scatter", mode: "markers", name: `${name} (${chosen.length})`, x: chosen.map((i) => data.flat[i][0]), y: chosen.map((i) => data.flat[i][1]), marker,
      text: chosen.map((i) => `b ${data.mean[i]} ± ${data.sd[i]} N/m${within(i)}<br>score ${data.score[i]}` + (truth ? `<br>b* ${star(i)}` : "")), hovertemplate: "%{text}<extra></extra>" };
  });
  if (border) dots.push(border(colours.ink, 1.3));
  const pathColour = (k) => ["#cc79a7", "#e69f00", "#56b4e9", "#009e73"][k % 4];
  paths.forEach(({ flat }, k) => dots.push({ type: "scatter", mode: "lines", x: flat[0], y: flat[1], line: { color: pathColour(k), width: 1.5 }, hoverinfo: "skip", showlegend: false }));
  Plotly.newPlot("map-detected", dots, { ...flatLayout, height: 306, margin: { ...flatLayout.margin, b: 48 } }, still);
  const glyphs = { circle: "●", "circle-open": "○", x: "✖" };
  dots.slice(0, kinds.length).forEach((dot) => {
    const entry = document.createElement("span"), glyph = document.createElement("b");
    glyph.textContent = glyphs[dot.marker.symbol];
    glyph.style.color = dot.marker.color;
    entry.append(glyph, ` ${dot.name}`);
    document.getElementById("kinds").append(entry);
  });

  // ---- over time ---------------------------------------------------------------------------------------------
  const line = (name, y, colour, axis) => ({ type: "scatter", mode: "lines+markers", marker: { size: 4 }, name, x: series.index, y, line: { color: colour, width: 1.6 }, yaxis: axis, xaxis: "x",
    showlegend: false, hovertemplate: `%{y:.4g}<extra>${name}</extra>` });
  const rows = [["entropy of b [nat]", [["entropy", series.entropy, colours.seen]]], ["NIS / dof", [["NIS / dof", series.nis, colours.red]]]];
  if (series.measured_mm) rows.push(["RMS error [mm]", [["measured", series.measured_mm, colours.seen], ["estimated", series.estimated_mm, colours.unseen]]]);
  rows.push(["seen [%]", [["seen", series.seen.map((s) => 100 * s), colours.green]]]);
  rows.push(["energy per<br>particle [µJ]", [["boundary energy", series.energy.map((e) => (e === null ? null : 1e6 * e)), colours.ink]]]);
  if (series.update) rows.push(["time [s]", [["update", series.update, colours.seen], ["perception", series.perception, colours.unseen]]]);
  const height = 1 / rows.length, curves = [], layout = {
    height: 120 * rows.length + 60, margin: { l: 84, r: 110, t: 8, b: 44 }, font, paper_bgcolor: "#fff", plot_bgcolor: "#fff", hovermode: "x unified",
    xaxis: { title: { text: "frame" }, zeroline: false, gridcolor: "#eef1f4", anchor: `y${rows.length}` }, shapes: [], annotations: [],
  };
  rows.forEach(([title, lines], r) => {
    const key = r ? `yaxis${r + 1}` : "yaxis", axis = r ? `y${r + 1}` : "y", top = 1 - r * height;
    layout[key] = { title: { text: title, font: { size: 11 } }, domain: [top - height, top - 0.03], zeroline: false, gridcolor: "#eef1f4", nticks: 4, rangemode: r ? "tozero" : "normal" };
    lines.forEach(([name, y, colour], k) => {
      curves.push(line(name, y, colour, axis));
      if (lines.length > 1) layout.annotations.push({ x: 1.01, xref: "paper", xanchor: "left", y: top - 0.04 - 0.03 * k, yref: "paper", showarrow: false, text: name, font: { color: colour, size: 12 } });
    });
    if (title.startsWith("NIS")) layout.shapes.push({ type: "line", xref: "paper", x0: 0, x1: 1, yref: axis, y0: 1, y1: 1, line: { color: colours.soft, width: 1, dash: "dot" } });
  });
  grasps.forEach((g, k) => {
    layout.shapes.push({ type: "rect", xref: "x", x0: series.index[g.first] - 0.4, x1: series.index[g.last] + 0.4, yref: "paper", y0: 0, y1: 1, fillcolor: k % 2 ? "#eef1f4" : "#e6eaee", line: { width: 0 }, layer: "below" });
    layout.annotations.push({ x: (series.index[g.first] + series.index[g.last]) / 2, xref: "x", y: 1, yref: "paper", yanchor: "top", showarrow: false, text: `grasp ${k + 1}`, font: { size: 11, color: colours.soft } });
  });
  const cursor = layout.shapes.length;
  layout.shapes.push({ type: "line", xref: "x", x0: 0, x1: 0, yref: "paper", y0: 0, y1: 1, line: { color: colours.ink, width: 1 } });
  Plotly.newPlot("curves", curves, layout, config);

  // ---- frame by frame ----------------------------------------------------------------------------------------
  const extent = [0, 1, 2].map((axis) => {
    let low = Infinity, high = -Infinity;
    for (const step of [...steps, ...(truth ? truth.steps.filter(Boolean) : [])]) for (const v of step.xyz[axis]) if (v !== null) { low = Math.min(low, v); high = Math.max(high, v); }
    const room = 0.03 * (high - low) + 0.5;
    return [low - room, high + room];
  });
  const size = extent.map(([low, high]) => high - low), widest = Math.max(...size);
  const scene = (camera) => ({
    aspectmode: "manual", aspectratio: { x: 1.25 * size[0] / widest, y: 1.25 * size[1] / widest, z: 1.25 * size[2] / widest },
    ...Object.fromEntries(["x", "y", "z"].map((name, k) => [`${name}axis`, { title: { text: `${name} [mm]` }, range: extent[k], backgroundcolor: "#fff", gridcolor: "#dfe4e9", zeroline: false, nticks: 5 }])), camera,
  });
  const eye = { eye: { x: 0.1, y: -1.75, z: 1.05 }, center: { x: 0, y: 0, z: -0.3 } };
  const solid = (faces, step, values, scale, top, title) => ({ type: "mesh3d", i: faces[0], j: faces[1], k: faces[2], x: step.xyz[0], y: step.xyz[1], z: step.xyz[2], intensity: values, colorscale: scale, cmin: 0, cmax: top,
    lighting: { ambient: 0.72, diffuse: 0.5, specular: 0.05 }, lightposition: { x: 0, y: -2000, z: 3000 }, colorbar: { thickness: 9, len: 0.7, outlinewidth: 0, title: { text: title, side: "right" } }, hovertemplate: "%{intensity:.3g} N/m<extra></extra>" });
  const solidLayout = { height: 420, margin: { l: 0, r: 0, t: 24, b: 0 }, font, paper_bgcolor: "#fff", scene: scene(eye) };
  const colourBy = () => document.querySelector("input[name=colour]:checked").value;
  const state = { step: data.opening, playing: null };
  const shown = steps[state.step];
  const gripPaths = paths.map(({ xyz }, k) => ({ type: "scatter3d", mode: "lines", x: xyz[0], y: xyz[1], z: xyz[2], line: { color: pathColour(k), width: 5 }, hovertemplate: `grasp ${k + 1}<extra></extra>`, showlegend: false }));
  Plotly.newPlot("solid", [solid(data.faces, shown, shown.mean, scales.b, data.top_b, "mean b [N/m]"), ...gripPaths], solidLayout, config);
  const trueStep = (k) => { if (!truth) return null; for (let j = k; j >= 0; j--) if (truth.steps[j]) return truth.steps[j]; return truth.steps.find(Boolean) || null; };
  const drawsTruth = Boolean(truth && trueStep(state.step) && truth.faces.length && truth.faces[0].length);
  if (drawsTruth) {
    const now = trueStep(state.step);
    Plotly.newPlot("solid-truth", [solid(truth.faces, now, now.b, scales.b, data.top_b, "b* [N/m]")], { ...solidLayout, scene: scene(eye) }, config);
    const follow = (from, to) => document.getElementById(from).on("plotly_relayout", (change) => {
      const camera = change["scene.camera"];
      if (camera && JSON.stringify(camera) !== JSON.stringify(document.getElementById(to).layout.scene.camera)) Plotly.relayout(to, { "scene.camera": camera });
    });
    follow("solid", "solid-truth");
    follow("solid-truth", "solid");
  } else if (truth) {
    document.getElementById("solid-truth").textContent = "The truth has no mesh or no frames to draw.";
  }

  const drawPoints = (side, picture) => {
    const canvas = document.getElementById(`${side}-points`), [width, tall] = picture.size, sharp = 2;
    canvas.width = width * sharp;
    canvas.height = tall * sharp;
    if (!document.getElementById("points").checked) return;
    const pen = canvas.getContext("2d"), uv = picture[`uv_${side}`];
    pen.scale(sharp, sharp);
    picture.state.forEach((kind, i) => {
      const [u, v] = uv[i];
      if (u === null || v === null) return;
      pen.beginPath();
      if (kind === 2) pen.rect(u - 2.5, v - 2.5, 6, 6); else pen.arc(u + 0.5, v + 0.5, kind ? 3.2 : 2.8, 0, 2 * Math.PI);
      if (kind !== 1) { pen.fillStyle = kind ? colours.held : colours.seen; pen.fill(); }
      pen.lineWidth = kind === 1 ? 1.5 : 0.8;
      pen.strokeStyle = kind === 1 ? colours.unseen : kind ? "#111" : "#fff";
      pen.stroke();
    });
  };
  const showPicture = (frame) => {
    if (!pictures.length) return;
    const picture = pictures.reduce((best, candidate) => (Math.abs(candidate.step - frame) < Math.abs(best.step - frame) ? candidate : best));
    for (const side of ["left", "right"]) {
      document.getElementById(side).src = picture[side];
      drawPoints(side, picture);
    }
    document.getElementById("picture-note").textContent = picture.step === frame ? "" : `nearest picture: frame ${series.index[picture.step]}`;
  };
  const show = () => {
    const step = steps[state.step], by = colourBy(), frame = step.frame;
    const grasp = grasps.findIndex((g) => g.first <= frame && frame <= g.last);
    document.getElementById("now").textContent = `frame ${series.index[frame]} · ${series.time[frame].toFixed(2)} s · ` + (grasp < 0 ? "nothing held" : `grasp ${grasp + 1}`);
    Plotly.restyle("solid", { x: [step.xyz[0]], y: [step.xyz[1]], z: [step.xyz[2]], intensity: [step[by]], colorscale: by === "mean" ? scales.b : scales.sd,
      cmax: by === "mean" ? data.top_b : data.top_sd, "colorbar.title.text": by === "mean" ? "mean b [N/m]" : "sd of b [N/m]" }, [0]);
    if (drawsTruth) { const now = trueStep(state.step); Plotly.restyle("solid-truth", { x: [now.xyz[0]], y: [now.xyz[1]], z: [now.xyz[2]], intensity: [now.b] }); }
    Plotly.relayout("curves", { [`shapes[${cursor}].x0`]: series.index[frame], [`shapes[${cursor}].x1`]: series.index[frame] });
    showPicture(frame);
  };
  const slider = document.getElementById("slider"), play = document.getElementById("play");
  const stop = () => { clearInterval(state.playing); state.playing = null; play.textContent = "▶"; };
  slider.addEventListener("input", () => { stop(); state.step = Number(slider.value); show(); });
  play.addEventListener("click", () => {
    if (state.playing) return stop();
    play.textContent = "❚❚";
    state.playing = setInterval(() => { state.step = (state.step + 1) % steps.length; slider.value = state.step; show(); }, 350);
  });
  document.querySelectorAll("input[name=colour]").forEach((choice) => choice.addEventListener("change", show));
  if (pictures.length) document.getElementById("points").addEventListener("change", show);
  slider.value = state.step;
  show();
  document.documentElement.dataset.ready = "yes";
})();
