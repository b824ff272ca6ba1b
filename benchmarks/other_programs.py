"""Render exported files with programs that share no code with SigmaSplat: three.js, Spark and Blender.

three.js and Spark are packages of Node in a folder, `npm install --prefix build/readers three @sparkjsdev/spark`; they
run in headless Chromium. Blender is a Python that has bpy. A view is T_world_camera [4, 4] in the levelled y-up axes of
a mesh or of a shared page, with x right, y down, z forward.
"""

import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any

import numpy as np
import record
from PIL import Image

from sigmasplat.errors import SigmaSplatError
from sigmasplat.types import Matrix

sys.path.append(str(record.ROOT / "tests"))
from headless_browser import Page, Pixels, chromium, wait_for

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From our camera axes to those of OpenGL."""
KINDS = {".glb": "gltf", ".usdz": "usd", ".stl": "stl", ".spz": "splats"}
"""How three.js reads a file; a PLY is a mesh or splats."""
PAGE = """<!doctype html><meta charset="utf-8"><body style="margin:0"><script type="importmap">{"imports": {
  "three": "/node_modules/three/build/three.module.js", "three/addons/": "/node_modules/three/examples/jsm/",
  "@sparkjsdev/spark": "/node_modules/@sparkjsdev/spark/dist/spark.module.js"}}</script><script type="module">
import * as THREE from "three";
const job = await (await fetch("/job.json")).json();
const renderer = new THREE.WebGLRenderer({ antialias: true });
renderer.setSize(job.width, job.height);
document.body.append(renderer.domElement);
const scene = new THREE.Scene(), fov = 2 * Math.atan(job.height / 2 / job.focal) * 180 / Math.PI;
scene.background = new THREE.Color(job.background);
const camera = new THREE.PerspectiveCamera(fov, job.width / job.height, 0.02, 100);
new THREE.Matrix4().set(...job.T).decompose(camera.position, camera.quaternion, camera.scale);
const addon = async (name, kind) => new (await import(`three/addons/loaders/${name}.js`))[name]();
const readers = {
  gltf: async () => (await (await addon("GLTFLoader")).loadAsync(job.url)).scene,
  usd: async () => await (await addon("USDLoader")).loadAsync(job.url),
  ply: async () => new THREE.Mesh(await (await addon("PLYLoader")).loadAsync(job.url),
    new THREE.MeshBasicMaterial({ vertexColors: true, side: THREE.DoubleSide })),
  stl: async () => new THREE.Mesh(await (await addon("STLLoader")).loadAsync(job.url),
    new THREE.MeshStandardMaterial({ color: 0xc8ccd0, side: THREE.DoubleSide, flatShading: true })),
  splats: async () => {
    const { SplatMesh, SparkRenderer } = await import("@sparkjsdev/spark");
    scene.add(new SparkRenderer({ renderer }));
    const mesh = new SplatMesh({ url: job.url });
    await mesh.initialized;
    return mesh;
  },
};
const object = new THREE.Group();
object.add(await readers[job.kind]());
object.rotation.x = job.turn;
scene.add(object, new THREE.HemisphereLight(0xffffff, 0x404040, 2.5));
const light = new THREE.DirectionalLight(0xffffff, 1.5);
light.position.set(1, 3, 2);
scene.add(light);
scene.updateMatrixWorld(true);

// What the mesh is in three.js's own axes: its size, and which share of its area is level or upright.
const box = new THREE.Box3(), a = new THREE.Vector3(), b = new THREE.Vector3(), c = new THREE.Vector3();
let area = 0, level = 0, upright = 0, textures = 0;
object.traverse((mesh) => {
  if (!mesh.isMesh || job.kind === "splats") return;
  box.expandByObject(mesh, true);
  textures += [mesh.material].flat().filter((m) => m.map || m.emissiveMap).length;
  const at = mesh.geometry.attributes.position, faces = mesh.geometry.index, corners = faces ? faces.count : at.count;
  for (let i = 0; i < corners; i += 3) {
    [a, b, c].forEach((p, k) => {
      p.fromBufferAttribute(at, faces ? faces.getX(i + k) : i + k).applyMatrix4(mesh.matrixWorld);
    });
    const n = b.sub(a).cross(c.sub(a)), size = n.length();
    area += size;
    level += size * (Math.abs(n.y) > 0.996 * size);
    upright += size * (Math.abs(n.y) < 0.087 * size);
  }
});
if (area) window.facts = { size_m: box.getSize(a).toArray(), level: level / area, upright: upright / area, textures };
let frames = 0;
renderer.setAnimationLoop(() => {
  renderer.render(scene, camera);
  window.drawn = ++frames;
});
</script>"""


@dataclass(frozen=True, eq=False)
class View:
    """A camera: T_world_camera, y up; focal length in pixels; size (width, height) of the image."""

    T_world_camera: Matrix
    focal: float
    size: tuple[int, int]


def in_three(path: Path, view: View, node: Path, turn: float = 0.0, kind: str = "") -> tuple[Pixels, dict[str, Any]]:
    """Draw a file in three.js, splats by Spark; return the image, and for a mesh its size in m (x, y, z), the shares of
    its area within 5° of level and of upright, and its number of textures.

    turn: about x, radians, as a person would turn what is not y-up. Raises SigmaSplatError if the packages are missing.
    """
    if not (node / "node_modules" / "three").is_dir():
        raise SigmaSplatError(f"{node} has no three; npm install --prefix {node} three @sparkjsdev/spark")
    width, height = view.size
    job = {
        "url": f"/{path.name}", "kind": kind or KINDS[path.suffix], "turn": turn, "width": width, "height": height,
        "focal": view.focal, "T": (view.T_world_camera @ OPENGL).ravel().tolist(), "background": "#202428",
    }  # fmt: skip
    with TemporaryDirectory(prefix="three-") as name:
        site = Path(name)
        (site / "node_modules").symlink_to((node / "node_modules").resolve())
        (site / path.name).symlink_to(path.resolve())
        (site / "index.html").write_text(PAGE, encoding="utf-8")
        (site / "job.json").write_text(json.dumps(job))
        server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=name))
        Thread(target=server.serve_forever, daemon=True).start()
        try:
            url = f"http://127.0.0.1:{server.server_address[1]}/index.html"
            frames = 6 if job["kind"] == "splats" else 2  # Spark sorts beside the drawing
            return photographed(url, view.size, f"window.drawn > {frames}", "window.facts")
        finally:
            server.shutdown()
            server.server_close()


def photographed(
    url: str, size: tuple[int, int], ready: str, facts: str = "null", before: str = "", phone: bool = False
) -> tuple[Pixels, dict[str, Any]]:
    """Open a page in headless Chromium; return its image as soon as `ready` holds, and the value of `facts` there.

    before: an expression that is evaluated when it is ready; then it must be ready once more.
    """
    with TemporaryDirectory(prefix="profile-") as profile, chromium("about:blank", Path(profile)) as port:
        page = Page(port)
        for domain in ("Runtime", "Log", "Page"):
            page.call(f"{domain}.enable")
        page.call(
            "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=phone
        )  # fmt: skip
        page.call("Emulation.setTouchEmulationEnabled", enabled=phone)
        page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
        page.call("Page.navigate", url=url)
        for expression in ("", *([before] if before else [])):
            if expression:
                page.value(expression)
            wait_for(lambda: page.value(ready) is True)
        return page.screenshot(), page.value(facts) or {}


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *given: Any) -> None:
        """Log nothing."""


BLENDER = """
import json, sys
import bpy
import numpy as np
from mathutils import Matrix
job = json.loads(sys.argv[-1])
bpy.ops.wm.read_factory_settings(use_empty=True)
{"glb": bpy.ops.import_scene.gltf, "usdz": bpy.ops.wm.usd_import, "ply": bpy.ops.wm.ply_import,
 "stl": bpy.ops.wm.stl_import}[job["path"].rsplit(".", 1)[1]](filepath=job["path"])
low, high, area, level, upright, images = np.full(3, np.inf), np.full(3, -np.inf), 0.0, 0.0, 0.0, set()
for thing in [o for o in bpy.data.objects if o.type == "MESH"]:
    mesh, T = thing.data, np.array(thing.matrix_world)
    points = np.empty(3 * len(mesh.vertices)); mesh.vertices.foreach_get("co", points)
    points = points.reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
    low, high = np.minimum(low, points.min(0)), np.maximum(high, points.max(0))
    corners = np.empty(len(mesh.loops), np.int32); mesh.loops.foreach_get("vertex_index", corners)
    a, b, c = points[corners.reshape(-1, 3)].swapaxes(0, 1)
    n = np.cross(b - a, c - a); size = np.linalg.norm(n, axis=1); area += size.sum()
    level += size[np.abs(n[:, 2]) > 0.996 * size].sum(); upright += size[np.abs(n[:, 2]) < 0.087 * size].sum()
    for material in mesh.materials:
        images |= {node.image.name for node in material.node_tree.nodes if node.type == "TEX_IMAGE" and node.image}
print("facts", json.dumps({"size_m": (high - low).tolist(), "level": level / area, "upright": upright / area,
                           "textures": len(images)}))
scene, camera = bpy.context.scene, bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(camera)
scene.camera, camera.matrix_world = camera, Matrix(job["T"])
camera.data.sensor_fit, camera.data.sensor_width, camera.data.clip_start = "HORIZONTAL", 36.0, 0.02
camera.data.lens = 36.0 * job["focal"] / job["width"]
scene.world = bpy.data.worlds.new("world"); scene.world.use_nodes = True
scene.world.node_tree.nodes["Background"].inputs[0].default_value = (0.015, 0.018, 0.021, 1.0)
scene.render.engine, scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", "CPU", 8, False
scene.view_settings.view_transform = "Standard"
scene.render.resolution_x, scene.render.resolution_y = job["width"], job["height"]
scene.render.filepath = job["out"]
bpy.ops.render.render(write_still=True)
"""
"""What Blender runs. A glTF has y up, Blender z: its importer turns it, and the camera is given in Blender's axes."""


def in_blender(path: Path, view: View, python: Path) -> tuple[Pixels, dict[str, Any]]:
    """Render a mesh with Blender's Cycles; return the image and the same facts as `in_three`, in Blender's z-up axes.

    Raises SigmaSplatError if that fails.
    """
    z_up_from_y_up = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    with TemporaryDirectory(prefix="blender-") as folder:
        out = Path(folder) / "image.png"
        job = {
            "path": str(path.resolve()), "out": str(out), "focal": view.focal, "width": view.size[0],
            "height": view.size[1], "T": (z_up_from_y_up @ view.T_world_camera @ OPENGL).tolist(),
        }  # fmt: skip
        done = subprocess.run(
            [str(python), "-c", BLENDER, json.dumps(job)], capture_output=True, text=True, check=False
        )  # fmt: skip
        told = [line[6:] for line in done.stdout.splitlines() if line.startswith("facts ")]
        if not told or not out.exists():
            raise SigmaSplatError(f"{python} with bpy could not render {path.name}: {done.stderr.strip()[-300:]}")
        return np.asarray(Image.open(out).convert("RGB")), dict(json.loads(told[0]))


def described(program: str, facts: Mapping[str, Any]) -> str:
    """Write what a program measures of a mesh."""
    x, y, z = facts["size_m"]
    return (
        f"{program}: {x:.3f} × {y:.3f} × {z:.3f} m, {facts['level']:.0%} of the area level, {facts['upright']:.0%} "
        f"upright, {facts['textures']} textures"
    )
