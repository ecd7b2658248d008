// Charts by plotly. Colours are the page's own, read as a chart is drawn. A panel's title, with its unit, stands above it,
// and the keys of its lines above the chart, where they wrap as text does.

import { colour, fill, make, say } from "./dom.js";

const OPTIONS = { displayModeBar: false, doubleClick: "reset", showTips: false };
const drawn = new Map(); // element: how to draw it again, in other colours

const rgba = (name, alpha) => {
  const hex = colour(name).replace("#", "");
  const part = (at) => parseInt(hex.slice(at, at + 2), 16);
  return `rgba(${part(0)},${part(2)},${part(4)},${alpha})`;
};

const axis = (more = {}) => ({
  gridcolor: colour("line"),
  linecolor: colour("line-strong"),
  zerolinecolor: colour("line-strong"),
  tickfont: { size: 11 },
  automargin: true,
  fixedrange: false,
  ...more,
});

const below = (title, more = {}) => axis({ title: { text: title, font: { size: 12 }, standoff: 6 }, ...more });

// There is no half a generation.
const generations = (last) => below("generation", { rangemode: "nonnegative", ...(last < 8 && { dtick: 1 }) });

// What a panel shows, above its upper edge `y`, as a share of the chart's height.
const heading = (text, y = 1) => ({
  text, x: 0, y, xref: "paper", yref: "paper", xanchor: "left", yanchor: "bottom", yshift: 3, showarrow: false,
  font: { size: 12, color: colour("ink") },
});

const layout = (more) => ({
  font: { family: "system-ui, sans-serif", color: colour("muted"), size: 12 },
  paper_bgcolor: "rgba(0,0,0,0)",
  plot_bgcolor: "rgba(0,0,0,0)",
  margin: { l: 40, r: 10, t: 24, b: 36 },
  showlegend: false,
  hovermode: "x unified",
  hoverlabel: { bgcolor: colour("card"), bordercolor: colour("line-strong"), font: { color: colour("ink"), size: 12 } },
  dragmode: "zoom",
  ...more,
});

// A chart is as large as its card, which changes as others come and go.
const sizes = new ResizeObserver((seen) => {
  for (const { target } of seen) if (target.isConnected && drawn.has(target)) window.Plotly.Plots.resize(target);
});

const draw = (element, compose) => {
  if (!drawn.has(element)) sizes.observe(element);
  drawn.set(element, compose);
  const { traces, shape, keys } = compose();
  showKeys(element, keys);
  window.Plotly.react(element, traces, layout(shape), OPTIONS);
};

// The keys stand in a list before the chart: its sibling, so that plotly leaves it alone.
const showKeys = (element, keys) => {
  const list = element.previousElementSibling;
  if (!list?.classList.contains("keys")) return;
  fill(list, keys, () => {
    const each = make("li");
    each.append(make("i"), make("span"));
    return each;
  }, (each, { kind, ink, name }) => {
    each.firstChild.className = `key ${kind}`;
    each.firstChild.style.color = `var(--${ink})`;
    say(each.lastChild, name);
  });
};

// In place of a chart that has nothing to show yet: what will come.
export const placeholder = (element, text) => {
  const said = element.nextElementSibling;
  element.hidden = Boolean(text);
  said.hidden = !text;
  say(said, text);
  if (text) showKeys(element, []);
  if (text && drawn.delete(element)) {
    sizes.unobserve(element);
    window.Plotly.purge(element);
  }
};

export const redraw = () => {
  for (const [element, compose] of drawn) {
    if (element.isConnected) draw(element, compose);
    else {
      drawn.delete(element);
      sizes.unobserve(element);
    }
  }
};

export const forget = () => {
  sizes.disconnect();
  for (const element of drawn.keys()) window.Plotly?.purge(element);
  drawn.clear();
};

// The elites' fitness, a cell each; empty cells show the card.
const drawArchive = (element, { x, y, z, cells, x_title, y_title }) => {
  const [x_name, y_name] = [x_title, y_title].map((title) => title.split(" (")[0]);
  const narrow = element.clientWidth < 480; // there is no room for what a measure means
  draw(element, () => ({
    traces: [{
      type: "heatmap", x, y, z, customdata: cells, colorscale: "Viridis", hoverongaps: false, xgap: 1, ygap: 1,
      hovertemplate: `${x_name} %{x:.4~g}<br>${y_name} %{y:.4~g}<br>fitness %{z:.4~g}<br>--cell %{customdata}<extra></extra>`,
      colorbar: { title: { text: "fitness of the elite", side: "right" }, thickness: 14, outlinewidth: 0 },
    }],
    shape: {
      hovermode: "closest", xaxis: below(narrow ? x_name : x_title, { showgrid: false, zeroline: false }),
      yaxis: axis({ title: { text: narrow ? y_name : y_title.replace(" (", "<br>("), font: { size: 12 }, standoff: 6 }, showgrid: false, zeroline: false }),
    },
    keys: [],
  }));
};

// Of a run with an archive alone.
export const fillArchive = (page, { run, archive }) => {
  page["archive-card"].hidden = !archive;
  if (!archive) return;
  say(page["archive-caption"], archive.caption);
  page.archive.setAttribute("aria-label", `Elites of ${run}: ${archive.caption}`);
  placeholder(page.archive, archive.filled ? "" : "No candidate was scored, so there is nothing to draw.");
  if (archive.filled) drawArchive(page.archive, archive);
};

const line = (x, y, name, ink, more = {}) => ({
  type: "scatter", mode: x.length === 1 ? "markers" : "lines", x, y, name, line: { color: colour(ink), width: 2 },
  marker: { color: colour(ink), size: 7 }, hovertemplate: "%{y:.4~g}", ...more,
});

const points = (of, name, ink, more = {}) => ({
  type: "scatter",
  mode: of.generation.length > 1 ? "lines+markers" : "markers",
  x: of.generation,
  y: of.mean,
  error_y: { type: "data", array: of.error, color: colour(ink), thickness: 1.2, width: 2 },
  marker: { color: colour(ink), size: 6 },
  line: { color: colour(ink), width: 1.2, dash: "dot" },
  name,
  hovertemplate: "%{y:.4~g}",
  ...more,
});

const star = (of, x, name, ink, more = {}) => ({
  type: "scatter", mode: "markers", x: [x], y: [of.mean], name,
  error_y: { type: "data", array: [of.error], color: colour(ink), thickness: 1.4, width: 4 },
  marker: { color: colour(ink), size: 14, symbol: "star", line: { color: colour("card"), width: 1 } },
  hovertemplate: of.error === null ? "%{y:.4~g}" : "%{y:.4~g} ± %{error_y.array:.2~g}",
  ...more,
});

const [UPPER, LOWER] = [[0.54, 1], [0, 0.44]]; // two panels above each other

// A function has values; any other task has a fitness.
export const title = ({ score_word }) => (score_word === "value" ? "Value of the function" : "Fitness");

// What a reader of the curve must know, below it.
export const caption = ({ step, note }) => [step > 1 ? `Every ${step}th generation is drawn.` : "", note].filter(Boolean).join(" ");

const logarithmic = { type: "log", exponentformat: "power", dtick: 1, minor: { showgrid: false } };

// What candidates scored, and what their mean did in reality: of a dream in two panels, for these are two worlds.
export const fitness = (element, curves) => {
  const { generation, low, high, mean, best, evaluations, confirmed, dreamt } = curves;
  const apart = dreamt && (evaluations.generation.length > 0 || Boolean(confirmed));
  element.classList.toggle("two", apart);
  draw(element, () => {
    const real = apart ? { yaxis: "y2" } : {};
    const edge = { line: { width: 0 }, mode: "lines", hoverinfo: "skip", hovertemplate: null };
    const traces = [
      line(generation, low, "", "blue", edge),
      line(generation, high, "", "blue", { ...edge, fill: "tonexty", fillcolor: rgba("blue", 0.18) }),
      line(generation, best, "best candidate", "orange", { line: { color: colour("orange"), width: 1.3 } }),
      line(generation, mean, "average of the candidates", "blue"),
    ];
    const keys = [
      { kind: "line", ink: "blue", name: "average of the candidates" }, { kind: "band", ink: "blue", name: curves.band },
      { kind: "thin", ink: "orange", name: "best candidate" },
    ];
    if (evaluations.generation.length) {
      traces.push(points(evaluations, "evaluated mean", "green", real));
      keys.push({ kind: "dots", ink: "green", name: "evaluated mean ± standard error" });
    }
    if (confirmed) {
      traces.push(star(confirmed, confirmed.generation, "confirmed", "red", real));
      keys.push({ kind: "star", ink: "red", name: "confirmed" });
    }
    const shape = {
      xaxis: { ...generations(generation.at(-1) ?? 0), ...(apart && { anchor: "y2" }) },
      yaxis: axis({ ...(apart && { domain: UPPER }), ...(curves.log && logarithmic) }),
      annotations: [heading(curves.fitness_axis)],
      shapes: curves.stages.map((since) => ({
        type: "line", x0: since - 0.5, x1: since - 0.5, y0: 0, y1: 1, yref: "paper",
        line: { color: colour("line-strong"), width: 1, dash: "dash" },
      })),
    };
    if (apart) {
      shape.yaxis2 = axis({ domain: LOWER, nticks: 6 });
      shape.annotations.push(heading(curves.score_axis, LOWER[1]));
    }
    if (curves.stages.length) keys.push({ kind: "dash", ink: "line-strong", name: "a stage begins" });
    return { traces, shape, keys };
  });
};

// The step size.
export const search = (element, curves) =>
  draw(element, () => {
    const traces = [line(curves.generation, curves.sigma, "step size", "purple")];
    const shape = {
      xaxis: generations(curves.generation.at(-1) ?? 0),
      yaxis: axis({ type: "log", exponentformat: "power", dtick: 1, minor: { showgrid: false } }),
      annotations: [heading("step size (logarithmic)")],
    };
    // A single decade or less has its own ticks, or there would be one at most.
    const steps = curves.sigma.filter((each) => each > 0);
    if (steps.length && Math.max(...steps) / Math.min(...steps) < 30) {
      delete shape.yaxis.dtick;
      shape.yaxis.nticks = 5;
    }
    return { traces, shape, keys: [] };
  });

const PAIR = ["blue", "orange"];

// Two runs on one chart.
export const both = (element, runs, over, of) =>
  draw(element, () => {
    const traces = [];
    const keys = [];
    runs.forEach(({ run, curves }, index) => {
      const ink = PAIR[index];
      const { evaluations, confirmed } = curves;
      keys.push({ kind: of === "candidates" ? "line" : "dots", ink, name: run });
      if (of === "candidates") traces.push(line(curves[over], curves.mean, run, ink));
      else {
        traces.push(points({ ...evaluations, generation: evaluations[over] }, run, ink, { line: { color: colour(ink), width: 2 } }));
        if (confirmed) {
          traces.push(star(confirmed, confirmed[over], `${run}, confirmed`, ink));
          keys.push({ kind: "star", ink, name: "confirmed" });
        }
      }
    });
    const labels = new Set(runs.map(({ curves }) => (of === "candidates" ? curves.fitness_axis : curves.score_axis)));
    const label = labels.size === 1 ? [...labels][0] : of === "candidates" ? "fitness, of each run's own kind" : "score of the mean, whole episodes";
    const last = Math.max(...runs.map(({ curves }) => curves.generation.at(-1) ?? 0));
    return {
      traces,
      keys,
      shape: {
        xaxis: over === "generation" ? generations(last) : below([...new Set(runs.map(({ curves }) => curves.spent_axes[over]))].join(", or "), { rangemode: "tozero" }),
        yaxis: axis(runs.every(({ curves }) => curves.log) ? logarithmic : {}),
        annotations: [heading(label)],
        hovermode: "closest",
      },
    };
  });

// Differences with the bars that a significant one does not reach zero with.
export const differences = (element, rows, title) =>
  draw(element, () => ({
    traces: [{
      type: "scatter", mode: "markers", x: rows.map((each) => each.mean), y: rows.map((each) => each.of),
      error_x: { type: "data", array: rows.map((each) => each.half), color: colour("ink"), thickness: 1.6, width: 5 },
      marker: { color: rows.map((each) => colour(each.better ? PAIR[1] : PAIR[0])), size: 11 },
      hovertemplate: "%{x:.4~g} ± %{error_x.array:.3~g}<extra></extra>",
    }],
    keys: [],
    shape: {
      xaxis: below(title, { zerolinewidth: 2, zerolinecolor: colour("muted"), rangemode: "tozero" }),
      yaxis: axis({ autorange: "reversed", showgrid: false, tickfont: { size: 12, color: colour("ink") } }),
      margin: { l: 40, r: 16, t: 8, b: 40 },
      hovermode: "closest",
    },
  }));

// What hosts did over the run's time, stacked: the largest ones in colours of their own.
export const stacked = (element, since, width, series, title, { whole = false } = {}) =>
  draw(element, () => {
    const moments = series[0].values.map((_, at) => new Date(1000 * (since + width * (at + 0.5))));
    const most = Math.max(1, ...moments.map((_, at) => series.reduce((sum, { values }) => sum + values[at], 0)));
    return {
      traces: series.map(({ name, ink, values }) => ({
        type: "scatter", mode: "lines", x: moments, y: values, name, stackgroup: "hosts", line: { width: 0.5, color: colour(ink), shape: "hvh" },
        fillcolor: rgba(ink, 0.65), hovertemplate: "%{y:.3~s}",
      })),
      keys: series.map(({ name, ink }) => ({ kind: "area", ink, name })),
      shape: { xaxis: axis({ type: "date" }), yaxis: axis({ rangemode: "tozero", ...(whole && { dtick: Math.ceil(most / 6) }) }), annotations: [heading(title)] },
    };
  });
