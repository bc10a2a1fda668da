// A coloured point cloud in WebGL that rotates about its centre. Coordinates: x right, y down, z forward [m].
function pointsView(canvas) {
  const gl = canvas.getContext("webgl", { antialias: false });
  if (!gl) return null;
  const program = link(
    `attribute vec3 point; attribute vec3 colour; varying vec3 shade;
     uniform mat3 turn; uniform vec3 pivot; uniform vec2 lens; uniform float distance; uniform float size;
     void main() {
       vec3 seen = turn * (point - pivot) + vec3(0.0, 0.0, distance);
       gl_Position = vec4(lens * seen.xy, (seen.z * 100.05 - 10.0) / 99.95, seen.z); // near 0.05 m, far 100 m
       gl_PointSize = clamp(size * point.z / seen.z, 1.0, 24.0);
       shade = colour;
     }`,
    `precision mediump float; varying vec3 shade; void main() { gl_FragColor = vec4(shade, 1.0); }`,
  );
  const buffers = { point: gl.createBuffer(), colour: gl.createBuffer() };
  const place = (name) => gl.getUniformLocation(program, name);
  const START = { yaw: -0.3, pitch: 0.16, zoom: 1 };
  let view = { ...START }, count = 0, pivot = 2, focal = 1, across = 1, waiting = false;

  function link(...sources) {
    const made = gl.createProgram();
    sources.forEach((source, i) => {
      const shader = gl.createShader(i ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    });
    gl.linkProgram(made);
    gl.useProgram(made);
    return made;
  }

  // Fills a buffer and declares its layout: three numbers per point.
  function fill(name, values, type) {
    const where = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers[name]);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(where);
    gl.vertexAttribPointer(where, 3, type, type === gl.UNSIGNED_BYTE, 0, 0);
  }

  // depth [mm] and rgba have width x height pixels, edges a bit each; camera: fx, fy, cx, cy in those pixels.
  function show({ width, height, depth, edges, rgba, camera }) {
    const [fx, fy, cx, cy] = camera;
    const points = new Float32Array(3 * width * height), colours = new Uint8Array(3 * width * height);
    count = 0;
    for (let v = 0, i = 0; v < height; v++) {
      for (let u = 0; u < width; u++, i++) {
        const z = depth[i] / 1000;
        if (!z || (edges[i >> 3] << (i & 7)) & 128) continue; // points of edges fly between two surfaces
        const at = 3 * count++;
        points[at] = ((u - cx) * z) / fx;
        points[at + 1] = ((v - cy) * z) / fy;
        points[at + 2] = z;
        for (let c = 0; c < 3; c++) colours[at + c] = rgba[4 * i + c];
      }
    }
    const sorted = Uint16Array.from(depth).sort();
    pivot = sorted[sorted.length >> 1] / 1000 || 2;
    focal = (2 * fx) / width; // the field of view of the camera
    across = width;
    fill("point", points.subarray(0, 3 * count), gl.FLOAT);
    fill("colour", colours.subarray(0, 3 * count), gl.UNSIGNED_BYTE);
    view = { ...START };
    draw();
  }

  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      const scale = Math.min(window.devicePixelRatio || 1, 2);
      const width = Math.round(canvas.clientWidth * scale), height = Math.round(canvas.clientHeight * scale);
      if (!width || !height) return;
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
      const [a, b] = [view.yaw, view.pitch], [ca, sa, cb, sb] = [Math.cos(a), Math.sin(a), Math.cos(b), Math.sin(b)];
      gl.viewport(0, 0, width, height);
      gl.clearColor(0.086, 0.094, 0.114, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      gl.uniformMatrix3fv(place("turn"), false, [ca, sa * sb, sa * cb, 0, cb, -sb, -sa, ca * sb, ca * cb]);
      gl.uniform3f(place("pivot"), 0, 0, pivot);
      gl.uniform2f(place("lens"), focal, -focal * (width / height));
      gl.uniform1f(place("distance"), (1.3 * pivot) / view.zoom);
      gl.uniform1f(place("size"), (2 * width) / across);
      gl.drawArrays(gl.POINTS, 0, count);
    });
  }

  function turn(dx, dy) {
    view.yaw = Math.max(-3.2, Math.min(3.2, view.yaw + dx));
    view.pitch = Math.max(-1.5, Math.min(1.5, view.pitch + dy));
    draw();
  }

  function zoom(factor) {
    view.zoom = Math.max(0.2, Math.min(12, view.zoom * factor));
    draw();
  }

  function reset() {
    view = { ...START };
    draw();
  }

  const held = new Map();
  const spread = () => {
    const [a, b] = [...held.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = held.get(event.pointerId);
    if (!last) return;
    const before = held.size === 2 ? spread() : 0;
    held.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (before) zoom(spread() / before);
    else turn((event.clientX - last.x) / 150, (last.y - event.clientY) / 150);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => held.delete(event.pointerId));
  canvas.addEventListener("dblclick", reset);
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 500));
  }, { passive: false });
  const KEYS = {
    ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, 0.1),
    ArrowDown: () => turn(0, -0.1), "+": () => zoom(1.15), "-": () => zoom(1 / 1.15), 0: reset,
  };
  canvas.addEventListener("keydown", (event) => {
    if (!KEYS[event.key]) return;
    event.preventDefault();
    KEYS[event.key]();
  });
  new ResizeObserver(draw).observe(canvas);
  return { show, draw };
}
