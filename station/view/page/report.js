"use strict";
// Draws the figures one after another, in the colours that the style sheet states for screen, dark screen or paper.
(() => {
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const places = [...document.querySelectorAll("[data-figure]")];
  const narrow = matchMedia("(max-width: 640px)");
  const coarse = matchMedia("(pointer: coarse)").matches;
  const config = {responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d"],
                  showSendToCloud: false, plotlyServerURL: ""};  // no button that would send the data anywhere

  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();

  function dress(figure) {
    const ink = colour("ink"), soft = colour("soft"), grid = colour("grid"), paper = colour("paper");
    for (const trace of figure.data) {
      const shade = colour(trace.meta.role);
      if (trace.line) trace.line.color = shade;
      if (trace.marker) trace.marker.color = shade;
      if (trace.error_y) trace.error_y.color = shade;
    }
    const layout = figure.layout;
    Object.assign(layout, {paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
                           font: {family: getComputedStyle(document.body).fontFamily, size: 12.5, color: ink},
                           hoverlabel: {bgcolor: paper, bordercolor: soft, font: {color: ink}},
                           modebar: {bgcolor: "rgba(0,0,0,0)", color: soft, activecolor: ink},
                           legend: {...layout.legend, font: {size: narrow.matches ? 11 : 12.5}, itemwidth: 30},
                           dragmode: coarse ? false : "zoom"});
    for (const [key, axis] of Object.entries(layout)) {
      if (!/^[xy]axis\d*$/.test(key)) continue;
      Object.assign(axis, {gridcolor: grid, zerolinecolor: colour("line"), linecolor: colour("line"), tickcolor: colour("line")});
      if (axis.title) axis.title.font = {size: 12.5, color: soft};
    }
    for (const note of layout.annotations || []) {
      if (!note.showarrow) continue;
      const shade = colour(note.name + "-text") || colour(note.name);
      Object.assign(note, {font: {color: shade}, arrowcolor: shade, bgcolor: paper, opacity: 0.95});
    }
    return figure;
  }

  function draw(place) {
    const figure = dress(figures[place.dataset.figure]);
    return Plotly.react(place, figure.data, {...figure.layout, autosize: true}, config)
      .then(() => { place.dataset.drawn = "yes"; });
  }

  const breathe = () => new Promise((done) => setTimeout(done, 0));
  const folded = (place) => place.closest("details:not([open])") !== null;
  const drawAll = () => Promise.all(places.filter((place) => place.dataset.drawn).map(draw));

  (async () => {
    for (const place of places) {
      if (folded(place)) continue;  // drawn when it is opened: it has no width before
      await draw(place);
      await breathe();
    }
    document.documentElement.dataset.figures = "drawn";
  })();

  for (const part of document.querySelectorAll("details")) {
    part.addEventListener("toggle", () => {
      for (const place of part.querySelectorAll("[data-figure]")) {
        if (!place.dataset.drawn && !folded(place)) draw(place);
      }
    });
  }

  function unfold(anchor) {
    const part = anchor.length > 1 && document.getElementById(anchor.slice(1))?.closest("details");
    if (part) part.open = true;
  }
  addEventListener("hashchange", () => unfold(location.hash));
  unfold(location.hash);

  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
  matchMedia("print").addEventListener("change", () => {
    for (const place of places) if (place.dataset.drawn) Plotly.Plots.resize(place);
    drawAll();
  });
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = [...document.querySelectorAll("details:not([open])")];
    for (const part of opened) part.open = true;
    for (const place of places) if (!place.dataset.drawn) draw(place);
  });
  addEventListener("afterprint", () => {
    for (const part of opened) part.open = false;
    opened = [];
  });
})();
