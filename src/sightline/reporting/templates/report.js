"use strict";
(() => {
  const box = document.getElementById("map");
  const svg = box.querySelector("svg");
  const tip = box.querySelector(".tip");
  const chosen = svg.querySelector(".chosen");
  const data = JSON.parse(document.getElementById("map-data").textContent);
  const picker = document.getElementById("recording");
  const reachPx = 24;
  const recordings = picker
    ? [...picker.options].slice(1).map((option) => option.textContent)
    : data.series.map((series) => series.recording);
  let home = data.view;
  let view = home.slice();

  const hidden = new Set();
  const shown = () => data.series.filter((series) =>
    !hidden.has(series.track ? "track" : "box") &&
    (!picker || picker.value === "" || recordings[picker.value] === series.recording));

  // The view is x, y, width and height in metres; it is widened to the shape of the window, so
  // that a metre is as long up as across and the whole window is map.
  const fitted = (wanted) => {
    const shape = svg.clientWidth / svg.clientHeight;
    const width = Math.max(wanted[2], wanted[3] * shape);
    const height = width / shape;
    return [wanted[0] + (wanted[2] - width) / 2, wanted[1] + (wanted[3] - height) / 2, width, height];
  };

  const draw = () => {
    svg.setAttribute("viewBox", view.join(" "));
    const metresPerPx = view[2] / svg.clientWidth;
    svg.querySelector(".camera").setAttribute("transform", `scale(${metresPerPx})`);
    svg.querySelector(".ring-labels").setAttribute("font-size", 11 * metresPerPx);
    let last = [0, 0];
    for (const label of svg.querySelectorAll(".ring-labels text")) {
      const place = [Number(label.getAttribute("x")), Number(label.getAttribute("y"))];
      const apart = Math.hypot(place[0] - last[0], place[1] - last[1]) > 48 * metresPerPx;
      label.classList.toggle("off", !apart);
      if (apart) last = place;
    }
    const most = 140 * metresPerPx;
    const power = 10 ** Math.floor(Math.log10(most));
    const length = [5, 2, 1].map((k) => k * power).find((k) => k <= most);
    const scale = box.querySelector(".scale");
    scale.style.visibility = "visible";
    scale.querySelector("i").style.width = `${length / metresPerPx}px`;
    scale.querySelector("span").textContent =
      length >= 1000 ? `${length / 1000} km` : length >= 1 ? `${length} m` : `${length * 100} cm`;
    box.classList.toggle("zoomed", view[2] < fitted(home)[2] * 0.99);
  };

  const zoom = (factor, x, y) => {
    const whole = fitted(home);
    const width = Math.min(Math.max(view[2] * factor, 2), whole[2] * 20);
    const real = width / view[2];
    view = [x - (x - view[0]) * real, y - (y - view[1]) * real, width, view[3] * real];
    draw();
  };

  const pan = (east, south) => {
    view[0] += east;
    view[1] += south;
    draw();
  };

  const reset = () => {
    view = fitted(home);
    draw();
  };

  const metres = (event) => {
    const frame = svg.getBoundingClientRect();
    return [
      view[0] + ((event.clientX - frame.left) / frame.width) * view[2],
      view[1] + ((event.clientY - frame.top) / frame.height) * view[3],
    ];
  };

  const forget = () => {
    tip.hidden = true;
    chosen.setAttribute("visibility", "hidden");
  };

  const compass = (degrees) =>
    ["N", "NE", "E", "SE", "S", "SW", "W", "NW"][Math.round(degrees / 45) % 8];

  const lines = (series, i) => {
    const out = [new Date(series.time[i] * 1000).toISOString().replace("T", " ").slice(0, 21) + " UTC"];
    if (series.track) {
      const speed = series.speed[i];
      out.push(`${speed.toFixed(1)} m/s (${(speed * data.knots).toFixed(1)} kn)` +
        `, course ${Math.round(series.course[i])}° ${compass(series.course[i])}`);
    }
    const range = Math.hypot(series.east[i], series.north[i]);
    out.push(`${range.toFixed(0)} m from the camera`);
    if (series.major[i] !== null) {
      out.push(`95 % within ${series.major[i].toFixed(1)} × ${series.minor[i].toFixed(1)} m`);
    }
    if (series.error[i] !== null) out.push(`${series.error[i].toFixed(1)} m from the log`);
    if (series.track) out.push(data.kinds[series.kind[i]]);
    return out;
  };

  const point = (event) => {
    const [x, y] = metres(event);
    let best = null;
    let nearest = (reachPx * view[2] / svg.clientWidth) ** 2;
    for (const series of shown()) {
      for (let i = 0; i < series.time.length; i++) {
        const distance = (series.east[i] - x) ** 2 + (-series.north[i] - y) ** 2;
        if (distance < nearest) {
          nearest = distance;
          best = [series, i];
        }
      }
    }
    if (!best) {
      forget();
      return;
    }
    const [series, i] = best;
    const [east, south] = [series.east[i], -series.north[i]];
    const ellipse = chosen.querySelector("ellipse");
    ellipse.setAttribute("cx", east);
    ellipse.setAttribute("cy", south);
    ellipse.setAttribute("rx", series.major[i] ?? 0);
    ellipse.setAttribute("ry", series.minor[i] ?? 0);
    ellipse.setAttribute("transform", `rotate(${(series.bearing[i] ?? 0) - 90} ${east} ${south})`);
    chosen.querySelector("path").setAttribute("d", `M${east} ${south}h0`);
    chosen.setAttribute("visibility", "visible");

    tip.replaceChildren();
    const heading = document.createElement("b");
    heading.textContent = series.recording ? `${series.recording}: ${series.name}` : series.name;
    tip.append(heading);
    for (const line of lines(series, i)) {
      const row = document.createElement("div");
      row.textContent = line;
      tip.append(row);
    }
    tip.hidden = false;
    const left = ((east - view[0]) / view[2]) * svg.clientWidth;
    const top = ((south - view[1]) / view[3]) * svg.clientHeight;
    const flip = left + 20 + tip.offsetWidth > svg.clientWidth;
    const x0 = flip ? left - 16 - tip.offsetWidth : left + 16;
    const y0 = Math.min(Math.max(top - tip.offsetHeight / 2, 6), svg.clientHeight - tip.offsetHeight - 6);
    tip.style.transform = `translate(${Math.max(x0, 6)}px, ${y0}px)`;
  };

  const fingers = new Map();
  svg.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, event);
    svg.setPointerCapture(event.pointerId);
    point(event);
  });
  svg.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) {
      point(event);
      return;
    }
    const perPx = view[2] / svg.clientWidth;
    if (fingers.size === 1) {
      pan((before.clientX - event.clientX) * perPx, (before.clientY - event.clientY) * perPx);
    } else if (fingers.size === 2) {
      const other = [...fingers.entries()].find(([id]) => id !== event.pointerId)[1];
      const was = Math.hypot(before.clientX - other.clientX, before.clientY - other.clientY);
      const now = Math.hypot(event.clientX - other.clientX, event.clientY - other.clientY);
      if (was > 0 && now > 0) zoom(was / now, ...metres(other));
    }
    fingers.set(event.pointerId, event);
    if (fingers.size > 1 || event.pointerType === "mouse") forget();
  });
  for (const end of ["pointerup", "pointercancel"]) {
    svg.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }
  svg.addEventListener("pointerleave", (event) => {
    if (event.pointerType === "mouse") forget();
  });
  svg.addEventListener("dblclick", (event) => zoom(0.5, ...metres(event)));
  svg.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    zoom(2 ** (Math.sign(event.deltaY) * 0.3), ...metres(event));
  }, { passive: false });

  const middle = () => [view[0] + view[2] / 2, view[1] + view[3] / 2];
  svg.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = 0.1 * view[2];
    const actions = {
      ArrowLeft: () => pan(-step, 0), ArrowRight: () => pan(step, 0),
      ArrowUp: () => pan(0, -step), ArrowDown: () => pan(0, step),
      "+": () => zoom(0.667, ...middle()), "=": () => zoom(0.667, ...middle()),
      "-": () => zoom(1.5, ...middle()), 0: reset, Escape: forget,
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
  });
  for (const button of box.querySelectorAll("button")) {
    const factor = Number(button.dataset.zoom);
    button.addEventListener("click", () => (factor ? zoom(factor, ...middle()) : reset()));
  }

  for (const toggle of document.querySelectorAll("[data-layer]")) {
    const layer = toggle.dataset.layer;
    const apply = () => {
      if (toggle.checked) hidden.delete(layer);
      else hidden.add(layer);
      for (const part of svg.querySelectorAll(`.recording > .${layer}`)) {
        part.classList.toggle("off", !toggle.checked);
      }
      forget();
    };
    toggle.addEventListener("change", apply);
    apply();
  }

  if (picker) {
    const pick = () => {
      for (const group of svg.querySelectorAll(".recording")) {
        group.classList.toggle("off", picker.value !== "" && group.dataset.recording !== picker.value);
      }
      forget();
      home = data.view;
      if (picker.value !== "") {
        const frame = svg.querySelector(`.recording[data-recording="${picker.value}"]`);
        const extents = [...frame.querySelectorAll("path")]
          .map((path) => path.getBBox()).filter((extent) => extent.width + extent.height > 0);
        if (extents.length) {
          const x0 = Math.min(...extents.map((e) => e.x));
          const y0 = Math.min(...extents.map((e) => e.y));
          const x1 = Math.max(...extents.map((e) => e.x + e.width));
          const y1 = Math.max(...extents.map((e) => e.y + e.height));
          const margin = 0.15 * Math.max(x1 - x0, y1 - y0, 10);
          home = [x0 - margin, y0 - margin, x1 - x0 + 2 * margin, y1 - y0 + 2 * margin];
        }
      }
      reset();
    };
    picker.addEventListener("change", pick);
    pick();
  }

  let shape = svg.clientWidth / svg.clientHeight;
  new ResizeObserver(() => {
    const now = svg.clientWidth / svg.clientHeight;
    if (Math.abs(now - shape) < 1e-6) {
      draw();
      return;
    }
    shape = now;
    reset();
  }).observe(svg);
  reset();
})();
