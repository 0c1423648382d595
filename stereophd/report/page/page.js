"use strict";
(() => {
  const RUNS = JSON.parse(document.getElementById("data").textContent).runs;
  const COLOURS = ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#b8a800"];
  const SYMBOLS = ["circle", "square", "diamond", "cross", "x", "circle-open", "square-open", "diamond-open"];
  const DASHES = ["solid", "dash", "dot", "dashdot"];
  const CONFIG = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["lasso2d", "select2d", "sendChartToCloud", "sendDataToCloud"], showSendToCloud: false, showEditInChartStudio: false };
  const FRAME_MS = 30;
  const TRAILS = [["1 s", 1], ["5 s", 5], ["20 s", 20], ["whole", Infinity], ["none", 0]];
  const by = (id) => document.getElementById(id);
  const PAPER_PX = 680;  // width of a printed plot; A4 and letter leave some more between their margins
  const state = { run: 0, beside: -1, time: 0, trail: 5, playing: null, camera: 0, screen: null, labels: null, fit: null };
  const MANY = 40;  // labels of more tracks than this hide what they name, and take seconds to draw
  const FAR = 2.5;  // what makes the scene larger than most of the objects by this factor does not set the view
  const MARKERS = 4000;  // of a plot; each is an element of the page
  const VERTICES = 10000;  // of the lines of a scene: they take most of the time of a scene without a graphics card
  const ROWS = 20, PRINTED_ROWS = 200;  // of a table

  // Numbers come as base64 of 32-bit floats.
  const cache = new Map();
  const numbers = (text) => {
    if (!cache.has(text)) {
      const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
      cache.set(text, new Float32Array(bytes.buffer));
    }
    return cache.get(text);
  };
  const colour = (k) => COLOURS[k % COLOURS.length];
  const symbol = (k) => SYMBOLS[Math.floor(k / COLOURS.length) % SYMBOLS.length];
  const dash = (k) => DASHES[Math.floor(k / COLOURS.length) % DASHES.length];
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const clock = (t) => `${(+t).toFixed(2)} s`;
  const count = (n, what) => `${n} ${what}${n === 1 ? "" : "s"}`;
  const run = () => RUNS[state.run];

  // ---- layout shared by all plots
  const axis = (title, more) => ({
    title: { text: title, font: { size: 12 }, standoff: 8 }, gridcolor: css("--line"), linecolor: css("--line"),
    zerolinecolor: css("--line"), automargin: true, ...more,
  });
  const LOG = { type: "log", tickformat: "~g", nticks: 4 };  // 0.05 and 0.1, not 5 and a power of ten; few, as they are uneven
  const layout = (title, x, y, more) => ({
    title: { text: title, font: { size: 14 }, x: 0.02, xanchor: "left" }, margin: { l: 60, r: 16, t: 40, b: 44 },
    paper_bgcolor: css("--paper"), plot_bgcolor: css("--paper"),
    font: { color: css("--ink"), family: "system-ui, 'DejaVu Sans', sans-serif", size: 12 },
    xaxis: axis(x), yaxis: axis(y), legend: { orientation: "h", y: -0.22, x: 0 }, hovermode: "closest", ...more,
  });
  const draw = (id, traces, settings) => {
    by(id).hidden = false;  // before plotly measures it
    return Plotly.react(by(id), traces, settings, CONFIG);
  };
  const clear = (id) => {
    if (by(id).data) Plotly.purge(by(id));
    by(id).hidden = true;
  };
  const since = (r, t) => Array.from(t, (s) => s + r.start);

  // ---- tracks
  const at = (t, from, to, time) => {
    // last row of [from, to) that is not after the time
    let low = from, high = to;
    while (low < high) { const mid = (low + high) >> 1; if (!(t[mid] > time)) low = mid + 1; else high = mid; }
    return low - 1;
  };
  const paths = (p) => ({ t: numbers(p.t), x: numbers(p.x), y: numbers(p.y), z: numbers(p.z) });
  // Rows of several paths as one line, with gaps between them, and a number for each row; of many, some and the last.
  const joined = (p, keep) => {
    const rows = paths(p), out = { x: [], y: [], z: [], k: [], text: [] }, spans = p.ids.map((_, k) => keep(rows, k));
    const step = Math.ceil(spans.reduce((sum, [from, to]) => sum + to - from, 0) / VERTICES);
    for (let k = 0; k < p.ids.length; k++) {
      const [from, to] = spans[k];
      for (let i = from; i < to; i = i + step < to || i === to - 1 ? i + step : to - 1) {
        out.x.push(rows.x[i]); out.y.push(rows.y[i]); out.z.push(rows.z[i]); out.k.push(k % COLOURS.length);
        out.text.push(`track ${p.ids[k]}, ${clock(rows.t[i] + run().start)}`);
      }
      if (to > from) { out.x.push(NaN); out.y.push(NaN); out.z.push(NaN); out.k.push(k % COLOURS.length); out.text.push(""); }
    }
    return out;
  };
  const SCALE = COLOURS.flatMap((c, k) => [[k / COLOURS.length, c], [(k + 1) / COLOURS.length, c]]);
  const coloured = (k, width) => ({ width, color: k, colorscale: SCALE, cmin: -0.5, cmax: COLOURS.length - 0.5 });
  const whole = (p) => joined(p, (rows, k) => [p.starts[k], p.starts[k + 1]]);
  const trail = (p, time) => joined(p, (rows, k) => {
    const [from, to] = [p.starts[k], p.starts[k + 1]];
    if (!(state.trail > 0) || numbers(p.first)[k] > time || numbers(p.last)[k] < time - state.trail) return [from, from];
    return [Math.max(at(rows.t, from, to, time - state.trail), from), at(rows.t, from, to, time) + 1];
  });
  const heads = (p, time, slack) => {
    const rows = paths(p), out = { x: [], y: [], z: [], text: [], k: [] };
    for (let k = 0; k < p.ids.length; k++) {
      if (numbers(p.first)[k] > time + slack || numbers(p.last)[k] < time - slack) continue;
      let i = Math.max(at(rows.t, p.starts[k], p.starts[k + 1], time), p.starts[k]);
      while (i > p.starts[k] && Number.isNaN(rows.x[i])) i--;
      out.x.push(rows.x[i]); out.y.push(rows.y[i]); out.z.push(rows.z[i]); out.text.push(`${p.ids[k]}`); out.k.push(k);
    }
    return out;
  };

  // Whether tracks have labels: as chosen, else where they are few.
  const labelled = () => by("labels").checked;
  // The ranges that are shown, with a margin, and whether they are the middle 98 % of each coordinate of what moves: as
  // chosen, else where all that is drawn is much larger (cameras far away, a track that goes astray). Null where nothing
  // moves.
  const shown = (r) => {
    const all = ["x", "y", "z"].map((name) => Float32Array.from([r.tracks, r.truth].flatMap((p) => (p && p.ids.length ? Array.from(numbers(p[name])) : [])).filter((q) => !Number.isNaN(q))).sort());
    if (all.some((values) => !values.length)) return null;
    const inner = all.map((q) => [q[Math.floor(0.01 * (q.length - 1))], q[Math.ceil(0.99 * (q.length - 1))]]);
    const outer = all.map((q, a) => { const eyes = r.cameras.map((c) => numbers(c.corners)[a]); return [Math.min(q[0], ...eyes), Math.max(q[q.length - 1], ...eyes)]; });
    const size = (box) => Math.max(...box.map(([low, high]) => high - low)) || 1;
    const fits = state.fit === null ? size(outer) > FAR * size(inner) : state.fit, box = fits ? inner : outer, margin = 0.08 * size(box);
    return { fits, ranges: box.map(([low, high]) => [low - margin, high + margin]) };
  };

  // ---- scene
  const frusta = (r, time) => {
    const out = { x: [], y: [], z: [], names: [], centers: [[], [], []] };
    for (const camera of r.cameras) {
      const c = numbers(camera.corners);
      const pose = camera.t.reduce((best, t, k) => (Math.abs(t - time) < Math.abs(camera.t[best] - time) ? k : best), 0);
      const corner = (k) => [0, 1, 2].map((a) => c[pose * 15 + 3 * k + a]);
      for (const path of [[0, 1, 2, 0, 3, 4, 0], [1, 4], [2, 3]]) {
        for (const k of path) { const q = corner(k); out.x.push(q[0]); out.y.push(q[1]); out.z.push(q[2]); }
        out.x.push(NaN); out.y.push(NaN); out.z.push(NaN);
      }
      // the upper edge of the image
      corner(0).forEach((value, a) => out.centers[a].push(value));
      out.names.push(camera.name);
    }
    return out;
  };
  const TRAIL = 2, NOW = 3, CAMERAS = 4, NAMES = 5;
  const slack = (r) => Math.max((r.end - r.start) / 1000, 1e-3);
  const moving = (r, time) => {
    const tracks = r.tracks, line = trail(tracks, time), now = heads(tracks, time, slack(r)), view = frusta(r, time);
    return [line, now, view];
  };
  const drawScene = (id, r) => {
    if (!r || !(r.tracks || r.truth || r.cameras.length)) { clear(id); return; }
    const tracks = r.tracks || { ids: [], starts: [0], t: "", x: "", y: "", z: "", first: "", last: "" };
    r.tracks = tracks;
    const all = whole(tracks), [line, now, view] = moving(r, state.time), u = r.unit ? ` [${r.unit}]` : "";
    const truth = r.truth ? whole(r.truth) : { x: [], y: [], z: [], text: [] };
    const common = { type: "scatter3d", showlegend: false };
    const traces = [
      { ...common, name: "truth", mode: "lines", x: truth.x, y: truth.y, z: truth.z, hoverinfo: "skip", line: { width: 3, color: css("--truth") }, opacity: 0.6 },
      { ...common, name: "tracks", mode: "lines", x: all.x, y: all.y, z: all.z, text: all.text, hoverinfo: "text", line: coloured(all.k, 1.5), opacity: 0.55 },
      { ...common, name: "trails", mode: "lines", x: line.x, y: line.y, z: line.z, text: line.text, hoverinfo: "text", line: coloured(line.k, now.x.length > MANY ? 2.5 : 7) },
      { ...common, name: "now", mode: labelled() ? "markers+text" : "markers", x: now.x, y: now.y, z: now.z, text: now.text, hovertext: now.text.map((t) => `track ${t}`), hoverinfo: "text", textposition: "top center",
        textfont: { size: 13, color: css("--ink") }, marker: { size: now.x.length > MANY ? 2.5 : 5, color: now.k.map(colour), symbol: now.k.map(symbol), line: { width: 1, color: css("--paper") } } },
      { ...common, name: "cameras", mode: "lines", x: view.x, y: view.y, z: view.z, hoverinfo: "skip", line: { width: 3, color: css("--camera") } },
      { ...common, name: "names", mode: "text", x: view.centers[0], y: view.centers[1], z: view.centers[2], text: view.names, hoverinfo: "text", textposition: "bottom center", textfont: { size: 13, color: css("--camera") } },
    ];
    const box = shown(r), sizes = box && box.ranges.map(([low, high]) => high - low);
    // whatever its form, the box has the diagonal of a cube of side 1, so that the viewpoints hold all of it
    const aspect = box ? { aspectmode: "manual", aspectratio: Object.fromEntries(sizes.map((s, k) => ["xyz"[k], (s * Math.sqrt(3)) / Math.hypot(...sizes)])) } : { aspectmode: "data" };
    const side = (k) => ({ ...axis(`${r.axes[k]}${u}`), ...(box ? { range: box.ranges[k] } : {}), backgroundcolor: css("--panel"), showbackground: false, color: css("--soft") });
    draw(id, traces, layout(RUNS.length > 1 ? r.name : "", "", "", {
      margin: { l: 0, r: 0, t: RUNS.length > 1 ? 32 : 0, b: 0 }, uirevision: `${r.name} ${box && box.fits}`,
      scene: { ...aspect, xaxis: side(0), yaxis: side(1), zaxis: side(2), camera: viewpoint("free", r), dragmode: "orbit" },
    }));
  };
  // The second scene takes half of the width, so the first one is measured after it has appeared or gone.
  const drawScenes = () => {
    drawScene("scene1", RUNS[state.beside]);
    drawScene("scene0", run());
    for (const [id] of shownScenes()) {
      const el = by(id);
      if (Math.abs(el._fullLayout.width - el.clientWidth) > 4) Plotly.Plots.resize(el);
    }
  };
  // Where the viewer is: obliquely from behind the cameras, above them or beside them.
  const viewpoint = (kind, r) => {
    const up = r.up, others = [0, 1, 2].filter((k) => up[k] === 0), [a, b] = others, eye = [0, 0, 0];
    // behind the middle of the cameras, where they look along an axis
    let forward = [0, 0, 0];
    for (const camera of r.cameras) {
      const c = numbers(camera.corners);
      for (let k = 0; k < 3; k++) forward[k] += (c[3 + k] + c[6 + k] + c[9 + k] + c[12 + k]) / 4 - c[k];
    }
    const length = Math.hypot(forward[a], forward[b]);
    const along = length > 0.2 * Math.hypot(...forward) ? [forward[a] / length, forward[b] / length] : [0.6, 0.8];
    const upright = { x: up[0], y: up[1], z: up[2] };
    if (kind === "top") {
      const heading = [0, 0, 0]; heading[a] = along[0]; heading[b] = along[1];
      return { up: { x: heading[0], y: heading[1], z: heading[2] }, eye: { x: 2.0 * up[0], y: 2.0 * up[1], z: 2.0 * up[2] }, projection: { type: "orthographic" } };
    }
    const turned = kind === "side" ? [-along[1], along[0]] : [-0.8 * along[0] - 0.55 * along[1], -0.8 * along[1] + 0.55 * along[0]];
    // farther away where the picture is narrow
    const back = 1.15 * Math.max(1, 1.5 * by("scene0").clientHeight / (by("scene0").clientWidth || 1));
    eye[a] = 1.8 * back * turned[0]; eye[b] = 1.8 * back * turned[1];
    for (let k = 0; k < 3; k++) eye[k] += (kind === "side" ? 0 : 0.85 * back) * up[k];
    // what is near looks larger: the middle of the picture is nearer than the middle of the scene
    const center = [0, 0, 0];
    if (kind === "free") { center[a] = -0.12 * along[0]; center[b] = -0.12 * along[1]; for (let k = 0; k < 3; k++) center[k] -= 0.22 * up[k]; }
    return { up: upright, center: { x: center[0], y: center[1], z: center[2] }, eye: { x: eye[0], y: eye[1], z: eye[2] }, projection: { type: kind === "side" ? "orthographic" : "perspective" } };
  };
  const shownScenes = () => [["scene0", run()], ["scene1", RUNS[state.beside]]].filter(([id, r]) => r && by(id).data);
  const moveScene = (id, r) => {
    const [line, now, view] = moving(r, state.time);
    Plotly.restyle(by(id), {
      x: [line.x, now.x, view.x, view.centers[0]], y: [line.y, now.y, view.y, view.centers[1]], z: [line.z, now.z, view.z, view.centers[2]],
      text: [line.text, now.text, [], view.names], hovertext: [[], now.text.map((t) => `track ${t}`), [], []],
      mode: ["lines", labelled() ? "markers+text" : "markers", "lines", "text"],
      "line.color": [line.k, undefined, undefined, undefined],
      "marker.color": [undefined, now.k.map(colour), undefined, undefined], "marker.symbol": [undefined, now.k.map(symbol), undefined, undefined],
    }, [TRAIL, NOW, CAMERAS, NAMES]);
  };
  let snapshot = null;
  const keepImage = () => {
    // WebGL does not print: the paper shows an image of each scene, on white
    clearTimeout(snapshot);
    snapshot = setTimeout(async () => {
      for (const id of ["scene0", "scene1"]) {
        const scene = by(id), image = by(`${id}-image`);
        image.hidden = !scene.data;
        if (!scene.data) continue;
        const side = (name) => ({ ...scene.layout.scene[name], color: "#444", gridcolor: "#bbb" });
        const white = {
          ...scene.layout, paper_bgcolor: "#fff", plot_bgcolor: "#fff", font: { ...scene.layout.font, color: "#000" },
          scene: { ...scene.layout.scene, xaxis: side("xaxis"), yaxis: side("yaxis"), zaxis: side("zaxis") },
        };
        const data = scene.data.map((trace) => (trace.name === "now" ? { ...trace, textfont: { ...trace.textfont, color: "#000" } } : trace));
        image.src = await Plotly.toImage({ data, layout: white, config: CONFIG }, { format: "png", width: 1100, height: 620 });
      }
    }, 2000);
  };

  // ---- camera frames
  const drawFrame = () => {
    const r = run();
    if (!r.frames || !r.frames.length) return;
    const k = Math.min(state.camera, r.frames.length - 1), frame = r.frames[k], camera = r.cameras[k];
    const times = numbers(frame.t);
    if (!times.length) { clear("frame"); by("frame-text").textContent = "no frames"; return; }
    let nearest = 0;
    times.forEach((t, n) => { if (Math.abs(t - state.time) < Math.abs(times[nearest] - state.time)) nearest = n; });
    const pick = (where, columns) => {
      const rows = [];
      numbers(where).forEach((n, i) => { if (n === nearest) rows.push(i); });
      return columns.map((c) => rows.map((i) => numbers(c)[i]));
    };
    const [u, v, owner, w, h] = pick(frame.at, [frame.u, frame.v, frame.track, frame.w, frame.h].filter((c) => c));
    const [su, sv, seen, ...sides] = pick(frame.seen_at, [frame.seen_u, frame.seen_v, frame.seen_track, frame.seen_left, frame.seen_top, frame.seen_right, frame.seen_bottom].filter((c) => c));
    // boxes of detections, and the images of bodies
    const shape = (type, x0, y0, x1, y1, color, dash) => ({ type, x0, y0, x1, y1, line: { width: 1.5, color, dash }, layer: "above" });
    const shapes = (w || []).map((_, i) => shape("rect", u[i] - w[i] / 2, v[i] - h[i] / 2, u[i] + w[i] / 2, v[i] + h[i] / 2, owner[i] < 0 ? css("--truth") : colour(owner[i]), "solid")).concat(
      (sides[0] || []).map((_, i) => shape("circle", sides[0][i], sides[1][i], sides[2][i], sides[3][i], colour(seen[i]), "dot")).filter((s) => Number.isFinite(s.x0)));
    const id = (n) => (n < 0 ? "no track" : `track ${r.tracks.ids[n]}`);
    const owned = u.map((_, i) => owner[i] >= 0), not = owned.map((o) => !o), of = (list, mask) => list.filter((_, i) => mask[i]);
    by("frame-text").textContent = `frame ${frame.frame[nearest]} at ${clock(times[nearest] + r.start)}: ${count(u.length, "detection")}, ${count(seen.length, "track")} in view`;
    draw("frame", [
      { type: "scatter", mode: "markers", name: "detections without a track", x: of(u, not), y: of(v, not), hoverinfo: "x+y", marker: { symbol: "x-thin", size: 9, line: { width: 2, color: css("--truth") } } },
      { type: "scatter", mode: "markers", name: "detections of tracks", x: of(u, owned), y: of(v, owned), text: of(owner, owned).map(id), hoverinfo: "text+x+y", marker: { symbol: "cross-thin", size: 11, line: { width: 2, color: of(owner, owned).map(colour) } } },
      { type: "scatter", mode: labelled() ? "markers+text" : "markers", name: "reprojected tracks", x: su, y: sv, text: seen.map((n) => `${r.tracks.ids[n]}`), hovertext: seen.map(id), hoverinfo: "text", textposition: "top right",
        textfont: { size: 11 }, marker: { symbol: "circle-open", size: 15, color: seen.map(colour), line: { width: 2 } } },
    ], layout(camera.name, "u [px]", "v [px]", {
      xaxis: axis("u [px]", { range: [-0.03 * camera.width, 1.03 * camera.width], constrain: "domain" }),
      yaxis: axis("v [px]", { range: [1.03 * camera.height, -0.03 * camera.height], scaleanchor: "x", constrain: "domain" }),
      shapes: [{ type: "rect", x0: -0.5, y0: -0.5, x1: camera.width - 0.5, y1: camera.height - 0.5, line: { width: 1, color: css("--soft") }, layer: "below" }, ...shapes],
      uirevision: `${r.name} ${camera.name}`,
    }));
    const parts = [];
    if (!r.whole_frames) parts.push("Without the log, only detections of tracks are shown: give it with --log.");
    if (!frame.whole) parts.push(`Frames shown: ${times.length}, spread over the recording.`);
    by("frame-note").textContent = parts.join(" ");
  };

  // ---- tracks over time
  const cursor = (id) => [{ type: "line", xref: "x", yref: "paper", x0: state.time + run().start, x1: state.time + run().start, y0: 0, y1: 1, line: { width: 1, dash: "dot", color: css("--accent") } }];
  const drawLives = () => {
    const r = run(), p = r.tracks;
    if (!p || !p.ids.length) { clear("lives"); clear("values"); return; }
    const first = numbers(p.first), last = numbers(p.last), traces = [];
    for (let c = 0; c < Math.min(COLOURS.length, p.ids.length); c++) {
      const x = [], y = [], text = [];
      for (let k = c; k < p.ids.length; k += COLOURS.length) {
        x.push(first[k] + r.start, last[k] + r.start, NaN); y.push(k, k, NaN);
        const label = `track ${p.ids[k]}: ${clock(first[k] + r.start)} to ${clock(last[k] + r.start)}`;
        text.push(label, label, "");
      }
      traces.push({ type: "scatter", mode: p.ids.length > MARKERS / 20 ? "lines" : "lines+markers", x, y, text, hoverinfo: "text", showlegend: false, line: { width: Math.max(0.5, Math.min(8, 240 / p.ids.length)), color: colour(c) }, marker: { size: 4, color: colour(c) } });
    }
    const step = Math.ceil(p.ids.length / 20), ticks = p.ids.map((_, k) => k).filter((k) => k % step === 0);
    draw("lives", traces, layout("When each track was reported", "time [s]", "track", {
      yaxis: axis("track", { tickvals: ticks, ticktext: ticks.map((k) => `${p.ids[k]}`), autorange: "reversed" }), shapes: cursor(),
    }));
    const name = by("quantity").value, values = numbers(p[name]), t = numbers(p.t), groups = new Map();
    for (let k = 0; k < p.ids.length; k++) {
      const key = `${k % COLOURS.length} ${dash(k)}`;
      if (!groups.has(key)) groups.set(key, { x: [], y: [], text: [], k });
      const g = groups.get(key);
      for (let i = p.starts[k]; i < p.starts[k + 1]; i++) { g.x.push(t[i] + r.start); g.y.push(values[i]); g.text.push(`track ${p.ids[k]}`); }
      g.x.push(NaN); g.y.push(NaN); g.text.push("");
    }
    const many = t.length > 30000 && state.screen === null;  // WebGL does not print
    draw("values", [...groups.values()].map((g) => ({
      type: many ? "scattergl" : "scatter", mode: "lines", x: g.x, y: g.y, text: g.text, hoverinfo: "text+x+y", showlegend: false, line: { width: 1.5, color: colour(g.k), dash: dash(g.k) },
    })), layout(QUANTITIES[name][0], "time [s]", `${QUANTITIES[name][0]}${QUANTITIES[name][1](r.unit || "length")}`, { shapes: cursor(), yaxis: axis(`${name.replace("_", " ")}${QUANTITIES[name][1](r.unit || "length")}`, name === "position_std" ? LOG : {}) }));
  };
  const of = (u) => ` [${u}]`;
  const QUANTITIES = {
    x: ["Position x", of], y: ["Position y", of], z: ["Position z", of], speed: ["Speed", (u) => ` [${u}/s]`],
    position_std: ["Standard deviation of the position", of], existence: ["Existence", () => ""],
  };

  // ---- residuals
  const drawResiduals = () => {
    const r = run();
    if (!r.residuals) { clear("residual-cameras"); clear("residual-time"); return; }
    const boxes = ["u", "v"].map((name, n) => {
      const x = [], y = [];
      r.residuals.forEach((one, k) => { for (const value of numbers(one[name])) { x.push(r.cameras[k].name); y.push(value); } });
      return { type: "box", name: `along ${name}`, x, y, marker: { size: 2, color: COLOURS[n] }, line: { width: 1.5 }, boxpoints: false, boxmean: true };
    });
    const hidden = r.residuals.reduce((sum, one) => sum + one.outliers, 0);
    draw("residual-cameras", boxes, layout(`Residuals by camera${hidden ? `, ${hidden} far larger ones not shown` : ""}`, "", "residual [px]", { boxmode: "group" }));
    const traces = [], total = r.residuals.reduce((sum, one) => sum + numbers(one.t).length, 0), step = Math.ceil(total / MARKERS);
    r.residuals.forEach((one, k) => {
      const t = numbers(one.t), u = numbers(one.u), v = numbers(one.v), order = Array.from(t.keys()).sort((i, j) => t[i] - t[j]);
      const bins = Math.max(1, Math.min(60, Math.floor(order.length / 15))), x = [], rms = [];
      for (let b = 0; b < bins; b++) {
        const part = order.slice(Math.floor((b * order.length) / bins), Math.floor(((b + 1) * order.length) / bins));
        if (!part.length) continue;
        x.push(part.reduce((s, i) => s + t[i], 0) / part.length + r.start);
        rms.push(Math.sqrt(part.reduce((s, i) => s + u[i] * u[i] + v[i] * v[i], 0) / (2 * part.length)));
      }
      traces.push({ type: "scatter", mode: "markers", x: since(r, t).filter((_, i) => i % step === 0), y: Array.from(t.keys()).filter((i) => i % step === 0).map((i) => Math.hypot(u[i], v[i]) / Math.SQRT2), showlegend: false, hoverinfo: "skip", opacity: 0.18, marker: { size: 3, color: colour(k) } });
      traces.push({ type: "scatter", mode: "lines", x, y: rms, name: r.cameras[k].name, line: { width: 2.5, color: colour(k), dash: dash(k) } });
    });
    draw("residual-time", traces, layout("Residuals over time: each, and the root mean square", "time [s]", "residual [px]", { shapes: cursor() }));
  };

  // ---- numbers of objects, scores
  // On a logarithmic scale a zero is a gap.
  const line = (r, t, y, name, c, more) => ({ type: "scatter", mode: "lines", x: since(r, t), y: Array.from(y), name, line: { width: 2, color: c, ...more } });
  const drawScores = () => {
    const r = run(), traces = [];
    if (!r.evaluation) { clear("ospa"); clear("gospa"); }  // before the others are measured
    if (r.scans) {
      const t = numbers(r.scans.t);
      traces.push(line(r, t, numbers(r.scans.cardinality_mean), "expected", COLOURS[4]));
      traces.push(line(r, t, numbers(r.scans.cardinality_estimate), "reported", COLOURS[0], { shape: "hv" }));
    }
    const e = r.evaluation, unit = e && e.base === "euclidean" && r.unit ? ` [${r.unit}]` : "";
    if (e) traces.unshift(line(r, numbers(e.t), numbers(e.n_truth), "truth", css("--truth"), { width: 5 }));
    if (!traces.length) clear("count");
    else draw("count", traces, layout("Number of objects", "time [s]", "objects", { shapes: cursor(), yaxis: axis("objects", { rangemode: "tozero" }) }));
    if (!e) return;
    const t = numbers(e.t);
    const spiky = (y) => { const s = Array.from(y).filter((q) => q > 0).sort((p, q) => p - q); return s.length > 4 && s[s.length - 1] > 10 * s[s.length >> 1]; };
    const scale = (name) => (spiky(numbers(e[name])) ? LOG : { rangemode: "tozero" });
    draw("ospa", [line(r, t, numbers(e.ospa), "OSPA", css("--ink")), line(r, t, numbers(e.ospa_localisation), "localisation", COLOURS[0]), line(r, t, numbers(e.ospa_cardinality), "cardinality", COLOURS[5])],
      layout(`OSPA (order ${e.order}, cutoff ${e.cutoff}${unit.replace(/[[\]]/g, "")})`, "time [s]", `OSPA${unit}`, { yaxis: axis(`OSPA${unit}`, scale("ospa")), shapes: cursor() }));
    draw("gospa", [line(r, t, numbers(e.gospa), "GOSPA", css("--ink")), line(r, t, numbers(e.gospa_localisation), "localisation", COLOURS[0]), line(r, t, numbers(e.gospa_missed), "missed objects", COLOURS[5]), line(r, t, numbers(e.gospa_false), "false tracks", COLOURS[3], { dash: "dot" })],
      layout("GOSPA and its parts", "time [s]", `GOSPA${unit}`, { yaxis: axis(`GOSPA${unit}`, scale("gospa")), shapes: cursor() }));
  };

  // ---- calibration
  const drawCalibration = () => {
    const c = run().calibration, r = run();
    if (!c) return;
    const p = c.parameters, names = p.map((q) => q.name), mean = p.map((q) => (q.mean === null ? 0 : q.mean) / q.prior);
    const text = p.map((q) => `${q.name}: ${q.mean === null ? "-" : q.mean.toPrecision(3)} +- ${q.std.toPrecision(2)} ${q.unit}, prior std ${q.prior.toPrecision(3)}`);
    // a line of text for each parameter
    for (const id of ["forest", "directions"]) by(id).style.height = `${Math.max(420, 110 + 20 * p.length)}px`;
    draw("forest", [
      { type: "scatter", mode: "markers", name: "prior, one std", x: names.map(() => 0), y: names, error_x: { type: "constant", value: 1, thickness: 8, width: 0, color: css("--line") }, marker: { size: 1, color: css("--line") }, hoverinfo: "skip" },
      { type: "scatter", mode: "markers", name: "posterior, one std", x: mean, y: names, text, hoverinfo: "text", error_x: { type: "data", array: p.map((q) => q.std / q.prior), thickness: 2, width: 4, color: css("--accent") },
        marker: { size: 8, color: p.map((q) => (q.determined ? css("--accent") : css("--doubt"))), symbol: p.map((q) => (q.determined ? "circle" : "diamond-open")) } },
    ], layout("Parameters, in standard deviations of their priors", "offset from the prior mean [prior std]", "", { margin: { l: 150, r: 16, t: 40, b: 44 }, yaxis: axis("", { autorange: "reversed", dtick: 1 }) }));
    draw("directions", [{ type: "bar", orientation: "h", x: c.directions.map((d) => d.ratio), y: c.directions.map((_, k) => k + 1), text: c.directions.map((d) => d.text), textposition: "none", hoverinfo: "x+text",
      marker: { color: c.directions.map((d) => (d.determined ? css("--accent") : css("--doubt"))) } }],
      layout("Observability: what the data determine", "posterior std / prior std", "direction", { xaxis: axis("posterior std / prior std", LOG), yaxis: axis("direction", { autorange: "reversed", dtick: 1 }) }));
    const k = +by("parameter").value || 0, j = +by("against").value || 0, label = (n) => `${p[n].name} [${p[n].unit}]`;
    if (c.history) {
      const t = since(r, numbers(c.history.t)), m = Array.from(numbers(c.history.mean[k])), s = Array.from(numbers(c.history.std[k]));
      draw("history", [
        { type: "scatter", mode: "lines", x: t, y: m.map((q, i) => q + 1.645 * s[i]), line: { width: 0 }, showlegend: false, hoverinfo: "skip" },
        { type: "scatter", mode: "lines", x: t, y: m.map((q, i) => q - 1.645 * s[i]), fill: "tonexty", fillcolor: "rgba(86,180,233,0.3)", line: { width: 0 }, name: "90 %", hoverinfo: "skip" },
        { type: "scatter", mode: "lines", x: t, y: m, name: "mean", line: { width: 2, color: css("--accent") } },
      ], layout(`${p[k].name}, given the log so far`, "time [s]", label(k)));
    } else clear("history");
    if (c.particles) {
      const x = Array.from(numbers(c.particles[k]));
      const traces = j === k ? [{ type: "histogram", x, marker: { color: COLOURS[4] }, nbinsx: 40 }] : [{ type: "scatter", mode: "markers", x, y: Array.from(numbers(c.particles[j])), marker: { size: 4, opacity: 0.5, color: css("--accent") } }];
      draw("posterior", traces, layout("Posterior of the offsets", label(k), j === k ? "particles" : label(j), { showlegend: false }));
    } else clear("posterior");
  };

  // ---- comparison
  const drawComparison = () => {
    if (RUNS.length < 2) return;
    const counts = [], scores = [];
    RUNS.forEach((r, k) => {
      const style = { dash: DASHES[k % DASHES.length] };  // lines that coincide stay visible
      if (r.scans) counts.push(line(r, numbers(r.scans.t), numbers(r.scans.cardinality_estimate), r.name, colour(k), { shape: "hv", ...style }));
      if (r.evaluation) scores.push(line(r, numbers(r.evaluation.t), numbers(r.evaluation.ospa), r.name, colour(k), style));
    });
    // what is cleared leaves its width to the other
    if (scores.length) draw("compare-ospa", scores, layout("OSPA", "time [s]", "OSPA", { yaxis: axis("OSPA", LOG) })); else clear("compare-ospa");
    if (counts.length) draw("compare-count", counts, layout("Number of objects reported", "time [s]", "objects")); else clear("compare-count");
  };

  // ---- what is there, and controls
  const options = (select, pairs, chosen) => {
    select.replaceChildren(...pairs.map(([text, value]) => new Option(text, value)));
    select.value = chosen;
  };
  const present = () => {
    const r = run();
    return {
      scene: !!(r.tracks || r.truth || r.cameras.length), frames: !!(r.frames && r.frames.some((frame) => frame.t.length)), tracks: !!(r.tracks && r.tracks.ids.length),
      residuals: !!(r.residuals && r.residuals.some((one) => one.t.length)), scans: !!(r.scans || r.evaluation), calibration: !!r.calibration,
    };
  };
  const show = () => {
    const r = run(), there = present();
    document.querySelectorAll("main > section").forEach((section, n) => {
      const needed = section.dataset.needs;
      section.hidden = section.classList.contains("comparison") ? RUNS.length < 2 : !!needed && !there[needed];
      section.id = `section${n}`;
    });
    by("sections").replaceChildren(...[...document.querySelectorAll("main > section")].filter((s) => !s.hidden).map((s) => {
      const item = document.createElement("li"), link = document.createElement("a");
      link.href = `#${s.id}`; link.textContent = s.dataset.title; item.append(link); return item;
    }));
    document.querySelectorAll(".details").forEach((one) => { one.hidden = +one.dataset.run !== state.run && +one.dataset.run !== state.beside; });
    options(by("camera"), r.cameras.map((c, k) => [c.name, k]), Math.min(state.camera, Math.max(r.cameras.length - 1, 0)));
    if (r.calibration) {
      options(by("parameter"), r.calibration.parameters.map((q, k) => [q.name, k]), by("parameter").value || 0);
      options(by("against"), r.calibration.parameters.map((q, k) => [q.name, k]), by("against").value || Math.min(1, r.calibration.parameters.length - 1));
    }
    by("grey").hidden = !r.truth;
    sayTime();
    by("labels").checked = state.labels === null ? !r.tracks || r.tracks.ids.length <= MANY : state.labels;
    by("fit").checked = !!(shown(r) || {}).fits;
    setTimeout(() => { if (there.scene) { drawScenes(); keepImage(); } drawFlat(); }, FRAME_MS);  // text and tables are there first
  };
  // A section is drawn when it comes near the window, and again when it is stale by then; on paper all are.
  const DRAW = { comparison: drawComparison, frames: drawFrame, tracks: drawLives, residuals: drawResiduals, scans: drawScores, calibration: drawCalibration };
  const near = new Set(), stale = new Set();
  const refresh = () => {
    const there = { ...present(), comparison: true };
    for (const name of [...stale].filter((one) => near.has(one) || state.screen !== null)) {
      stale.delete(name);
      if (there[name]) DRAW[name]();
    }
  };
  const redraw = (...names) => { names.forEach((name) => stale.add(name)); refresh(); };
  const drawFlat = () => redraw(...Object.keys(DRAW));
  const watcher = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      const name = target.dataset.needs || "comparison";
      if (isIntersecting) near.add(name); else near.delete(name);
    }
    refresh();
  }, { rootMargin: "200px" });
  document.querySelectorAll("main > section").forEach((section) => watcher.observe(section));
  const sayTime = () => {
    const r = run(), span = r.end - r.start;
    by("time").value = span > 0 ? Math.round((1000 * state.time) / span) : 0;
    by("now").textContent = clock(state.time + r.start);
    by("time").setAttribute("aria-valuetext", clock(state.time + r.start));
  };
  let waiting = false, later = null;
  const setTime = (time) => {
    const r = run();
    state.time = Math.min(Math.max(time, 0), r.end - r.start);
    sayTime();
    if (!waiting) {
      waiting = true;
      setTimeout(() => {
        waiting = false;
        shownScenes().forEach(([id, one]) => moveScene(id, one));
        redraw("frames");
        keepImage();
      }, FRAME_MS);
    }
    clearTimeout(later);
    later = setTimeout(() => {
      for (const id of ["lives", "values", "residual-time", "count", "ospa", "gospa"]) if (by(id).data) Plotly.relayout(by(id), { shapes: cursor(id) });
    }, 250);
  };
  // ---- long tables: sorted by a click on a heading, a page at a time
  const paged = (table) => {
    const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells], pager = document.createElement("div"), range = document.createElement("span");
    const rows = [...body.rows], value = (row, k) => { const text = row.cells[k].textContent, n = parseFloat(text.replaceAll(",", "")); return Number.isNaN(n) ? text : n; };
    let first = 0;
    const present = (from, many) => {
      first = Math.min(Math.max(from, 0), Math.max(rows.length - 1, 0));
      body.replaceChildren(...rows.slice(first, first + many));
      range.textContent = `${first + 1} to ${Math.min(first + many, rows.length)} of ${rows.length}`;
    };
    heads.forEach((head, k) => {
      if (!head.textContent) return;
      const button = document.createElement("button");
      button.type = "button"; button.textContent = head.textContent; head.replaceChildren(button);
      button.onclick = () => {
        const up = head.getAttribute("aria-sort") !== "ascending", sign = up ? 1 : -1;
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", up ? "ascending" : "descending");
        rows.sort((a, b) => { const [p, q] = [value(a, k), value(b, k)]; return sign * (typeof p === typeof q ? (p > q) - (p < q) : typeof p === "number" ? -1 : 1); });
        present(0, ROWS);
      };
    });
    for (const [text, label, step] of [["\u2039", "Rows before", -ROWS], ["\u203a", "Rows after", ROWS]]) {
      const button = document.createElement("button");
      button.type = "button"; button.textContent = text; button.setAttribute("aria-label", label);
      button.onclick = () => { if (first + step < rows.length) present(first + step, ROWS); };
      pager.append(button);
    }
    pager.className = "controls"; pager.append(range); table.after(pager);
    addEventListener("beforeprint", () => present(0, PRINTED_ROWS));
    addEventListener("afterprint", () => present(0, ROWS));
    present(0, ROWS);
  };
  document.querySelectorAll("section.table table").forEach((table) => { if (table.tBodies[0].rows.length > ROWS) paged(table); });

  const play = () => {
    const button = by("play"), r = run();
    if (state.playing !== null) { clearInterval(state.playing); state.playing = null; }
    else {
      if (state.time >= r.end - r.start) state.time = 0;
      // the whole recording in about 20 s
      state.playing = setInterval(() => { setTime(state.time + (r.end - r.start) / 200); if (state.time >= r.end - r.start) play(); }, 100);
    }
    button.setAttribute("aria-pressed", String(state.playing !== null));
    button.textContent = state.playing === null ? "Play" : "Stop";
  };
  // On paper the plots are light and as wide as the paper, regardless of the screen.
  const resize = (size) => document.querySelectorAll(".plot").forEach((plot) => {
    if (plot.data && !plot.id.startsWith("scene")) Plotly.relayout(plot, size);
  });
  const toPaper = () => {
    if (state.screen !== null) return;
    state.screen = document.documentElement.dataset.theme;
    document.documentElement.dataset.theme = "light";
    drawFlat();
    resize({ width: PAPER_PX, autosize: false });
  };
  const toScreen = () => {
    if (state.screen === null) return;
    document.documentElement.dataset.theme = state.screen;
    state.screen = null;
    resize({ width: null, autosize: true });
    drawFlat();
  };
  const setTheme = (theme) => { document.documentElement.dataset.theme = theme; show(); };

  options(by("run"), RUNS.map((r, k) => [r.name, k]), 0);
  options(by("beside"), [["none", -1], ...RUNS.map((r, k) => [r.name, k])], RUNS.length === 2 ? 1 : -1);
  options(by("trail"), TRAILS.map(([text, value]) => [text, value]), 5);
  options(by("quantity"), Object.entries(QUANTITIES).map(([name, q]) => [q[0], name]), "position_std");
  by("choice").hidden = RUNS.length < 2;
  state.beside = RUNS.length === 2 ? 1 : -1;
  by("run").onchange = (event) => { state.run = +event.target.value; state.time = run().end - run().start; show(); };
  by("beside").onchange = (event) => { state.beside = +event.target.value; show(); };
  by("time").oninput = (event) => setTime((event.target.value / 1000) * (run().end - run().start));
  by("trail").onchange = (event) => { state.trail = Number(event.target.value); setTime(state.time); };
  by("labels").onchange = (event) => { state.labels = event.target.checked; setTime(state.time); };
  by("fit").onchange = (event) => { state.fit = event.target.checked; drawScenes(); };
  by("camera").onchange = (event) => { state.camera = +event.target.value; drawFrame(); };
  by("quantity").onchange = drawLives;
  by("parameter").onchange = drawCalibration;
  by("against").onchange = drawCalibration;
  by("play").onclick = play;
  addEventListener("beforeprint", toPaper);
  addEventListener("afterprint", toScreen);
  by("print").onclick = () => window.print();
  by("theme").onclick = () => setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
  document.querySelectorAll("[data-view]").forEach((button) => {
    button.onclick = () => { shownScenes().forEach(([id, r]) => Plotly.relayout(by(id), { "scene.camera": viewpoint(button.dataset.view, r) })); keepImage(); };
  });
  state.time = (run().end - run().start) / 2;
  const prefers = window.matchMedia("(prefers-color-scheme: dark)");
  prefers.onchange = (event) => setTheme(event.matches ? "dark" : "light");
  setTheme(prefers.matches ? "dark" : "light");
})();
