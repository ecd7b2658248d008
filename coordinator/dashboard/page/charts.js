// Charts by plotly. Colours are the page's own, read as a chart is drawn.

import { colour } from "./dom.js";

const OPTIONS = { displayModeBar: false, doubleClick: "reset", showTips: false };
const drawn = new Map(); // element: how to draw it again, in other colours

const rgba = (name, alpha) => {
  const hex = colour(name).replace("#", "");
  const part = (at) => parseInt(hex.slice(at, at + 2), 16);
  return `rgba(${part(0)},${part(2)},${part(4)},${alpha})`;
};

const axis = (title, more = {}) => ({
  title: { text: title, font: { size: 12 }, standoff: 8 },
  gridcolor: colour("line"),
  linecolor: colour("line"),
  zerolinecolor: colour("line-strong"),
  tickfont: { size: 11 },
  automargin: true,
  fixedrange: false,
  ...more,
});

// There is no half a generation.
const generations = (last) => axis("generation", { rangemode: "nonnegative", ...(last < 8 && { dtick: 1 }) });

const layout = (more) => ({
  font: { family: "system-ui, sans-serif", color: colour("muted"), size: 12 },
  paper_bgcolor: "rgba(0,0,0,0)",
  plot_bgcolor: "rgba(0,0,0,0)",
  margin: { l: 48, r: 16, t: 8, b: 40 },
  legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0, font: { size: 12 }, traceorder: "normal" },
  hovermode: "x unified",
  hoverlabel: { bgcolor: colour("card"), bordercolor: colour("line-strong"), font: { color: colour("ink"), size: 12 } },
  dragmode: "zoom",
  ...more,
});

// A chart is as wide as its card, which changes as others come and go.
const widths = new ResizeObserver((seen) => {
  for (const { target } of seen) if (target.isConnected && drawn.has(target)) window.Plotly.Plots.resize(target);
});

const draw = (element, make) => {
  if (!drawn.has(element)) widths.observe(element);
  drawn.set(element, make);
  const { traces, shape } = make();
  window.Plotly.react(element, traces, layout(shape), OPTIONS);
};

export const redraw = () => {
  for (const [element, make] of drawn) {
    if (element.isConnected) draw(element, make);
    else {
      drawn.delete(element);
      widths.unobserve(element);
    }
  }
};

export const forget = () => {
  widths.disconnect();
  for (const element of drawn.keys()) window.Plotly?.purge(element);
  drawn.clear();
};

const line = (x, y, name, ink, more = {}) => ({
  type: "scatter", mode: x.length === 1 ? "markers" : "lines", x, y, name, line: { color: colour(ink), width: 2 }, hovertemplate: "%{y:.4~g}", ...more,
});

const points = (of, name, ink, more = {}) => ({
  type: "scatter",
  mode: of.generation.length > 1 ? "lines+markers" : "markers",
  x: of.generation,
  y: of.mean,
  legendrank: 1003,
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

// What candidates scored and what their mean did in reality: of a dream on two axes, for these are two worlds.
export const fitness = (element, curves) =>
  draw(element, () => {
    const { generation, low, high, mean, best, evaluations, confirmed, dreamt } = curves;
    const apart = dreamt && (evaluations.generation.length > 0 || confirmed);
    const real = apart ? { yaxis: "y2" } : {};
    const edge = { line: { width: 0 }, hoverinfo: "skip", hovertemplate: null, showlegend: false };
    const traces = [
      line(generation, low, "", "blue", edge),
      line(generation, high, curves.band, "blue", { ...edge, fill: "tonexty", fillcolor: rgba("blue", 0.16), showlegend: true, legendrank: 1002 }),
      line(generation, best, dreamt ? "best candidate, dreamt" : "best candidate", "orange", { line: { color: colour("orange"), width: 1.3 }, legendrank: 1001 }),
      line(generation, mean, dreamt ? "mean of candidates, dreamt" : "mean of candidates", "blue", { legendrank: 1000 }),
    ];
    if (evaluations.generation.length)
      traces.push(points(evaluations, dreamt ? "evaluated in reality (± standard error)" : "evaluated mean (± standard error)", "green", real));
    if (confirmed) traces.push(star(confirmed, confirmed.generation, "confirmed", "red", real));
    const shape = {
      xaxis: generations(generation.at(-1) ?? 0),
      yaxis: axis(curves.fitness_axis),
      shapes: curves.stages.map((since) => ({
        type: "line", x0: since - 0.5, x1: since - 0.5, y0: 0, y1: 1, yref: "paper",
        line: { color: colour("line-strong"), width: 1, dash: "dash" },
      })),
    };
    if (apart) shape.yaxis2 = axis(curves.score_axis, { overlaying: "y", side: "right", showgrid: false, zeroline: false, tickmode: "auto" });
    return { traces, shape };
  });

export const search = (element, curves) =>
  draw(element, () => {
    const traces = [line(curves.generation, curves.sigma, "step size", "purple")];
    const shape = {
      xaxis: generations(curves.generation.at(-1) ?? 0),
      yaxis: axis("step size (log)", { type: "log", exponentformat: "power", dtick: 1, minor: { showgrid: false } }),
    };
    // A single decade or less has its own ticks, or there would be one at most.
    const sizes = curves.sigma.filter((each) => each > 0);
    if (sizes.length && Math.max(...sizes) / Math.min(...sizes) < 30) delete shape.yaxis.dtick;
    if (curves.temperature) {
      traces.push(line(curves.generation, curves.temperature, "temperature of the dream", "red", { yaxis: "y2", line: { color: colour("red"), width: 1.6, dash: "dash", shape: "hv" } }));
      shape.yaxis2 = axis("temperature", { overlaying: "y", side: "right", showgrid: false, zeroline: false, rangemode: "tozero", tickmode: "auto" });
    }
    return { traces, shape };
  });

const OVER = {
  generation: "generation",
  steps: "environment steps in reality, evaluations included",
  core_hours: "core-hours that slots worked on accepted results",
};

// Two runs on one chart.
export const both = (element, runs, over, of) =>
  draw(element, () => {
    const traces = [];
    runs.forEach(({ run, curves }, index) => {
      const ink = ["blue", "orange"][index];
      const { evaluations, confirmed } = curves;
      if (of === "candidates") traces.push(line(curves[over], curves.mean, run, ink));
      else {
        traces.push(points({ ...evaluations, generation: evaluations[over] }, run, ink, { line: { color: colour(ink), width: 2 } }));
        if (confirmed) traces.push(star(confirmed, confirmed[over], `${run}, confirmed`, ink));
      }
    });
    const labels = new Set(runs.map(({ curves }) => (of === "candidates" ? curves.fitness_axis : curves.score_axis)));
    const label = labels.size === 1 ? [...labels][0] : of === "candidates" ? "fitness, of each run's own kind" : "score of the mean, whole episodes";
    return {
      traces,
      shape: {
        xaxis: over === "generation" ? generations(Math.max(...runs.map(({ curves }) => curves.generation.at(-1) ?? 0))) : axis(OVER[over], { rangemode: "nonnegative" }),
        yaxis: axis(label),
        hovermode: "closest",
      },
    };
  });
