// Draws each scene's point cloud and base poses on a canvas that turns by mouse, touch and keyboard.
"use strict";
(() => {
  const LOWEST = -0.1, HIGHEST = Math.PI / 2, STEP = Math.PI / 24;

  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));

  function start(figure) {
    const canvas = figure.querySelector("canvas");
    const status = figure.querySelector("output");
    const scene = JSON.parse(figure.querySelector("script").textContent);
    const context = canvas.getContext("2d");
    const points = new Int16Array(bytes(scene.points).buffer);
    const rgb = bytes(scene.rgb);
    const onTarget = bytes(scene.target);
    const count = onTarget.length;
    const home = { yaw: scene.yaw, pitch: 0.55, zoom: 1 };
    const camera = { ...home };
    const pointers = new Map();
    let shown = [], chosen = -1, frameRequested = false, pinch = 0;

    // The target frame has z up and its origin at the target's centre; the floor is at scene.floor.
    function projection() {
      const width = canvas.width, height = canvas.height;
      const cy = Math.cos(camera.yaw), sy = Math.sin(camera.yaw);
      const cp = Math.cos(camera.pitch), sp = Math.sin(camera.pitch);
      const scale = (camera.zoom * Math.min(width, height)) / (2.1 * scene.radius);
      const middle = scene.middle;
      return (x, y, z) => {
        const right = cy * x + sy * y, away = cy * y - sy * x, up = z - middle;
        return [width / 2 + scale * right, height / 2 - scale * (cp * up + sp * away), cp * away - sp * up, scale];
      };
    }

    function marker(x, y, size, good, filled, colour) {
      context.beginPath();
      if (good) {
        context.arc(x, y, size, 0, 2 * Math.PI);
      } else {
        context.moveTo(x - size, y - size * 0.8);
        context.lineTo(x + size, y - size * 0.8);
        context.lineTo(x, y + size);
        context.closePath();
      }
      context.strokeStyle = context.fillStyle = colour;
      context.lineWidth = Math.max(1, size / 3);
      if (filled) context.fill();
      context.stroke();
    }

    function line(project, from, to, colour) {
      const [x0, y0] = project(...from), [x1, y1] = project(...to);
      context.beginPath();
      context.moveTo(x0, y0);
      context.lineTo(x1, y1);
      context.strokeStyle = colour;
      context.lineWidth = 1;
      context.stroke();
    }

    function draw() {
      frameRequested = false;
      const ratio = window.devicePixelRatio || 1;
      const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
      const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
      context.fillStyle = "#ffffff";
      context.fillRect(0, 0, width, height);
      const project = projection(), floor = scene.floor, half = Math.ceil(scene.radius * 2) / 2;
      for (let at = -half; at <= half + 1e-6; at += 0.5) {
        line(project, [at, -half, floor], [at, half, floor], "#e3e7eb");
        line(project, [-half, at, floor], [half, at, floor], "#e3e7eb");
      }
      line(project, [0, 0, floor], [0, 0, 0], scene.colours.target);
      shown = scene.candidates.map(([x, y], k) => [...project(x, y, floor), k]);
      const items = [];
      for (let k = 0; k < count; k++) {
        const [x, y, depth] = project(
          points[3 * k] * scene.unit, points[3 * k + 1] * scene.unit, points[3 * k + 2] * scene.unit);
        items.push([depth, x, y, k]);
      }
      // Base poses lie on the floor: furniture in front of one hides it, but marks stay readable.
      const dot = Math.max(1.5, 0.013 * project(0, 0, 0)[3]), mark = Math.min(9 * ratio, Math.max(3 * ratio, 0.025 * project(0, 0, 0)[3]));
      items.sort((a, b) => b[0] - a[0]);
      for (const [, x, y, k] of items) {
        context.fillStyle = onTarget[k] ? scene.colours.target
          : `rgb(${rgb[3 * k]},${rgb[3 * k + 1]},${rgb[3 * k + 2]})`;
        context.fillRect(x - dot / 2, y - dot / 2, dot, dot);
      }
      for (const [x, y, , , k] of [...shown].sort((a, b) => b[2] - a[2])) {
        const [, , good, clear] = scene.candidates[k];
        marker(x, y, mark, good, clear, good ? scene.colours.good : scene.colours.bad);
      }
      if (chosen >= 0) {
        const [x, y] = shown[chosen];
        context.beginPath();
        context.arc(x, y, mark * 2, 0, 2 * Math.PI);
        context.strokeStyle = "#000000";
        context.lineWidth = 2 * ratio;
        context.stroke();
      }
      canvas.dataset.view = [camera.yaw, camera.pitch, camera.zoom].map((v) => v.toFixed(3)).join(" ");
    }

    function redraw() {
      if (!frameRequested) {
        frameRequested = true;
        requestAnimationFrame(draw);
      }
    }

    function turn(yaw, pitch) {
      camera.yaw += yaw;
      camera.pitch = Math.min(HIGHEST, Math.max(LOWEST, camera.pitch + pitch));
      redraw();
    }

    function zoom(factor) {
      camera.zoom = Math.min(8, Math.max(0.3, camera.zoom * factor));
      redraw();
    }

    function choose(k) {
      const n = scene.candidates.length;
      if (!n) return;
      chosen = ((k % n) + n) % n;
      const [x, y, good, clear, words] = scene.candidates[chosen];
      status.textContent = `Base pose ${words}: ${good ? "good" : "bad"}${clear ? "" : ", base collides"}, ` +
        `${Math.hypot(x, y).toFixed(2)} m from the target`;
      redraw();
    }

    const actions = {
      ArrowLeft: () => turn(-STEP, 0), ArrowRight: () => turn(STEP, 0),
      ArrowUp: () => turn(0, STEP), ArrowDown: () => turn(0, -STEP),
      "+": () => zoom(1.2), "=": () => zoom(1.2), "-": () => zoom(1 / 1.2),
      n: () => choose(chosen + 1), p: () => choose(chosen - 1),
      Home: () => { Object.assign(camera, home); redraw(); },
    };
    canvas.addEventListener("keydown", (event) => {
      const action = event.ctrlKey || event.altKey || event.metaKey ? null : actions[event.key];
      if (action) {
        event.preventDefault();
        action();
      }
    });
    for (const button of figure.querySelectorAll("button")) {
      button.addEventListener("click", () => actions[button.dataset.key]());
    }

    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      pinch = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) {
        point(event);
        return;
      }
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      if (pointers.size === 1) {
        turn((event.clientX - before[0]) * -0.008, (event.clientY - before[1]) * 0.008);
      } else {
        const [a, b] = [...pointers.values()];
        const apart = Math.hypot(a[0] - b[0], a[1] - b[1]);
        if (pinch) zoom(apart / pinch);
        pinch = apart;
      }
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => { pointers.delete(event.pointerId); pinch = 0; });
    }
    // The wheel scrolls the page until the view has the focus.
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas) return;
      event.preventDefault();
      zoom(Math.exp(-event.deltaY * 0.001));
    }, { passive: false });

    function point(event) {
      const box = canvas.getBoundingClientRect(), ratio = canvas.width / box.width;
      const x = (event.clientX - box.left) * ratio, y = (event.clientY - box.top) * ratio;
      let best = -1, near = 14 * ratio;
      for (const [px, py, , , k] of shown) {
        const apart = Math.hypot(px - x, py - y);
        if (apart < near) [near, best] = [apart, k];
      }
      if (best >= 0 && best !== chosen) choose(best);
    }

    new ResizeObserver(redraw).observe(canvas);
    redraw();
  }

  document.querySelectorAll(".scene-view").forEach(start);
})();
