// Draws the charts of a page with uPlot: hover shows values, dragging zooms, a double click ends it.
// Each .chart holds JSON as charts.py makes it.
(() => {
  const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "ink"];
  const DASHES = [[], [8, 4], [2, 3], [8, 3, 2, 3]];
  const HEIGHT = 230;  // pixels of a panel

  const ink = name => getComputedStyle(document.body).getPropertyValue(name).trim() || "#565b60";
  const colourOf = number => {
    const colour = COLOURS[number % COLOURS.length];
    return colour === "ink" ? ink("--ink") : colour;
  };
  const dashOf = number => DASHES[Math.floor(number / COLOURS.length) % DASHES.length];
  const short = value => value >= 1e6 ? `${+(value / 1e6).toPrecision(3)} M`
    : value >= 1e4 ? `${+(value / 1e3).toPrecision(3)} k` : String(+value.toPrecision(4));

  // 1, 2 and 5 of each decade: a loss often spans less than one
  const logSplits = (plot, axis, low, high) => {
    const splits = [];
    for (let decade = Math.floor(Math.log10(low)); decade <= Math.log10(high); decade++)
      for (const digit of [1, 2, 5]) splits.push(digit * 10 ** decade);
    return splits.filter(value => value >= low && value <= high);
  };
  const ranges = {
    linear: (plot, low, high) => {
      const room = 0.06 * (high - low) || 0.5;
      return [low - room, high + room];
    },
    log: (plot, low, high) => [low / 1.1, high * 1.1],
    count: (plot, low, high) => [0, 1.1 * high || 1],
  };

  // columns of uPlot: a band has two, between which it fills
  function seriesOf(lines) {
    const series = [], bands = [];
    for (const {label, colour, kind} of lines) {
      const stroke = () => colourOf(colour);
      const one = {
        label, stroke, width: 1.6, dash: dashOf(colour), spanGaps: true,
        value: (plot, value) => value == null ? "–" : short(value),
        points: {show: kind === "dots" || kind === "both", size: 5, stroke, fill: stroke},
      };
      if (kind === "steps") one.paths = uPlot.paths.stepped({align: 1});
      if (kind === "dots") one.paths = () => null;
      if (kind === "band") {
        const edge = {...one, stroke: () => "transparent"};
        series.push(edge, edge);
        bands.push({series: [series.length, series.length - 1],
                    fill: () => colourOf(colour) + "2e"});
      } else series.push(one);
    }
    return {series, bands};
  }

  function drawMarks(plot, marks, levels, named) {
    const {ctx, bbox} = plot, ratio = devicePixelRatio, bottom = bbox.top + bbox.height;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.strokeStyle = ctx.fillStyle = ink("--soft");
    ctx.lineWidth = ratio;
    ctx.font = `${11 * ratio}px system-ui, sans-serif`;
    const line = (x0, y0, x1, y1) => {
      ctx.beginPath();
      ctx.moveTo(x0, y0);
      ctx.lineTo(x1, y1);
      ctx.stroke();
    };
    for (const [x] of marks.grow || []) {
      const at = plot.valToPos(x, "x", true);
      line(at, bottom - 7 * ratio, at, bottom);
    }
    ctx.textAlign = "center";
    for (const [x] of marks.reset || [])
      ctx.fillText("▾", plot.valToPos(x, "x", true), bottom - 8 * ratio);
    ctx.textAlign = "left";
    ctx.setLineDash([5 * ratio, 4 * ratio]);
    (marks.level || []).forEach(([x, text], number) => {
      const at = plot.valToPos(x, "x", true);
      line(at, bbox.top, at, bottom);
      if (named) ctx.fillText(text, at + 3 * ratio, bbox.top + (11 + 12 * (number % 2)) * ratio);
    });
    for (const y of levels) {
      const at = plot.valToPos(y, "y", true);
      line(bbox.left, at, bbox.left + bbox.width, at);
    }
    ctx.restore();
  }

  function draw(node, key) {
    const chart = JSON.parse(node.querySelector("script").textContent), plots = [];
    for (const [number, panel] of chart.panels.entries()) {
      const place = node.appendChild(document.createElement("div"));
      const heading = place.appendChild(document.createElement("h4"));
      heading.textContent = panel.title;
      const {series, bands} = seriesOf(panel.lines);
      const axis = {stroke: () => ink("--soft"), grid: {stroke: () => ink("--line"), width: 1},
                    ticks: {show: false}, font: "12px system-ui, sans-serif"};
      const isLog = panel.scale === "log";
      const plot = new uPlot({
        width: place.clientWidth, height: HEIGHT, series: [{label: chart.x}, ...series], bands,
        scales: {x: {time: false, range: (plot, low, high) =>
                       [plot.data[0][0] === low ? Math.min(0, low) : low, high]},
                 y: {distr: isLog ? 3 : 1, range: ranges[panel.scale]}},
        axes: [{...axis, size: 28, label: chart.x, labelSize: 18, labelGap: 0, labelFont: axis.font},
               {...axis, size: 62, values: (plot, splits) => splits.map(short),
                ...(isLog ? {splits: logSplits, filter: (plot, splits) => splits} : {})}],
        legend: {markers: {width: 2}}, cursor: {sync: {key}, y: false},
        hooks: {drawClear: [plot => drawMarks(plot, chart.marks, panel.levels, !number)]},
      }, panel.data, place);
      // lines without a name are in the legend of none
      plot.root.querySelectorAll(".u-series").forEach((row, index) => {
        row.hidden = index > 0 && !series[index - 1].label;
      });
      plots.push([plot, place]);
    }
    new ResizeObserver(() => plots.forEach(([plot, place]) => {
      if (place.clientWidth !== plot.width) plot.setSize({width: place.clientWidth, height: HEIGHT});
    })).observe(node);
    matchMedia("(prefers-color-scheme: dark)").addEventListener(
      "change", () => plots.forEach(([plot]) => plot.redraw()));
  }

  document.querySelectorAll(".chart").forEach((node, number) => draw(node, `chart ${number}`));
})();
