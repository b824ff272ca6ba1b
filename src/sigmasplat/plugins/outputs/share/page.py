"""Write a run as one HTML page that any browser opens from the disk: splats, uncertainty, ruler and path.

Splats take 20 bytes before compression, in planes of one byte each (`PLANES`, in groups of four as the graphics card
reads them). Those that are shown by default come first. Colours do not depend on the viewing direction: they are those
seen from the mean direction of the keyframes.
"""

import base64
import gzip
import html
import io
import json
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

import sigmasplat.api as api
from sigmasplat.api import Doubles, GaussianField, RunError, SplatValues, harmonics, se3
from sigmasplat.plugins.evaluation.run_views import refined_fx
from sigmasplat.plugins.outputs.axes import Edge, levelled, transform_to
from sigmasplat.plugins.outputs.drawing.colormap import INFERNO
from sigmasplat.plugins.outputs.first_look import VIEWS, best_view, sure
from sigmasplat.plugins.outputs.floorplan.ground import sample_surfaces
from sigmasplat.plugins.outputs.run_reader import RunReader

PLANES = 20
"""High bytes of x, y, z, opacity; low bytes of x, y, z, log `depth_std_m`; three log scales, which part of the rotation
(wxyz) is the largest; the three others, 0; red, green, blue, 0. x, y, z: 16-bit fixed point in a cube."""
MOST_BYTES = 5_000_000
"""Size of a page that mail and messengers carry."""
SMALLEST_SCALE_M, SMALLEST_STD_M = 1e-4, 1e-5
"""Smaller values are raised to these: less than a pixel for anyone farther away than 10 cm."""
HERE = Path(__file__).parent


def export_page(reader: RunReader, target: Path, up: Edge = "auto", most_bytes: int = MOST_BYTES) -> str:
    """Write the page atomically; return how many splats it has, and how up was found.

    Raises RunError without a map or a path, or if the map has nan or inf.
    """
    run, trajectory = reader.run, reader.valid_path()
    path, known = trajectory.T_world_camera, run.uncertainty_of(field := run.read_map())
    flat, std = flat_colours(field, known), None if known is None else known.std
    shown = sure(field, known, path[:, :3, 3])
    frames = [row for row in reader.valid_frames() if reader.frames.log[row]["is_keyframe"]]
    keyframes = reader.poses_of(frames) if frames else trajectory
    poses = keyframes.T_world_camera
    field.keep(shown)
    renderer = api.FieldRenderer(reader.config.render, reader.config.backend)
    best = best_view([*sample_surfaces(field, keyframes, reader.camera, renderer, VIEWS)])
    start = int(api.evenly_spaced(len(poses), VIEWS)[best])
    with torch.inference_mode():
        poster = renderer(field, reader.camera, se3.inverse(poses[start])).color.cpu().clamp(0.0, 1.0).numpy()
    R_floor_world, said, _ = levelled(reader, up)
    T = transform_to("y-up", R_floor_world)
    values = SplatValues.of(flat.moved(torch.from_numpy(T)))
    data, scene = packed_within(values, std, shown.numpy(), most_bytes * 3 // 4 - 200_000)  # base64; all else
    positions = path[:: len(path) // 2000 + 1, :3, 3] @ T[:3, :3].T
    ends = np.concatenate([np.quantile(values.means[shown.numpy()], [0.01, 0.99], axis=0), positions])
    margin = 0.1 * np.linalg.norm(np.ptp(ends, axis=0))  # how far beyond the visitor may step
    scene |= {
        "path": positions.round(4).tolist(), "keyframes": (T @ poses).round(6).reshape(-1, 16).tolist(),
        "start": start, "bounds": [(ends.min(0) - margin).tolist(), (ends.max(0) + margin).tolist()],
        "width": reader.camera.width, "height": reader.camera.height, "focal": reader.camera.fx,
        "refined_fx": refined_fx(reader.config, api.Camera(**run.facts()["camera"])), "palette": INFERNO.tolist(),
    }  # fmt: skip
    time_s = float(trajectory.timestamps_s[0])
    if time_s < 1e9:  # September 2001: it does not count from 1970, so it does not tell the day
        time_s = (run.path / "run.json").stat().st_mtime
    day = datetime.fromtimestamp(time_s, UTC)
    subtitle = f"{day:%-d %B %Y} · {len(reader.frames):,} frames · made with SigmaSplat"
    api.write_text(target, page(run.path.resolve().name, subtitle, scene, data, poster))
    cut = len(values) - scene["count"]
    fewer = f"; {cut:,} that cover least are left out, for {most_bytes / 1e6:.0f} MB" if cut else ""
    return f"{scene['count']:,} splats, axes y-up ({said}){fewer}"


def flat_colours(field: GaussianField, known: api.MapUncertainty | None) -> GaussianField:
    """Return a copy without harmonics, in the colours seen from the mean direction of the keyframes if it is known.

    Raises RunError if a value is nan or inf.
    """
    flat = field.moved(torch.eye(4))
    if "harmonics" in flat.attributes and known is not None and known.splats.shape[1] >= 6:
        rows, away = flat.attributes["harmonics"].params, -known.splats[:, 3:6].to(flat.means)
        flat.colors[:] = harmonics.view_colors(flat.colors, rows, away, torch.zeros(3))
    flat.attributes.clear()
    if not torch.isfinite(flat.params).all():
        raise RunError("the map has nan or inf; it is damaged, make it again")
    return flat


def packed_within(
    values: SplatValues, std: api.SplatStd | None, shown: NDArray[np.bool_], most_bytes: int
) -> tuple[bytes, dict[str, Any]]:
    """Return what `packed` does, in at most so many bytes: splats of the smallest opacity times area are left out."""
    areas = np.exp(np.sort(values.log_scales, axis=1)[:, 1:].sum(1))
    ranked = np.argsort(-values.opacities * areas, kind="stable")
    while True:
        rest = None if std is None else std.depth_std_m.cpu().double().numpy()[ranked]
        data, scene = packed(values.ordered(ranked), rest, shown[ranked])
        if len(data) <= most_bytes:
            return data, scene
        ranked = ranked[: int(len(ranked) * min(0.98, 0.99 * most_bytes / len(data)))]


def packed(values: SplatValues, std_m: Doubles | None, shown: NDArray[np.bool_]) -> tuple[bytes, dict[str, Any]]:
    """Return the compressed `PLANES`, and what reading them needs: numbers of splats, origins and steps.

    std_m: `depth_std_m` [N], None if unknown; shown [N]: the splats that come first. Both parts are in Morton order,
    because similar neighbours compress better. Raises RunError if none is shown.
    """
    if not shown.any():
        raise RunError("the map has no splat that is sure enough to be shown; make it again with more frames")
    order = api.morton_order(values.means)
    order = order[np.argsort(~shown[order], kind="stable")]
    values, low = values.ordered(order), values.means.min(0)
    step = max(float((values.means.max(0) - low).max()), 1e-6) / 65535.0
    places = np.round((values.means - low) / step).astype(np.uint16).T
    scales, scale = logarithmic(np.exp(values.log_scales), SMALLEST_SCALE_M)
    stds, std = logarithmic(np.ones(len(values)) if std_m is None else std_m[order], SMALLEST_STD_M)
    which, others = api.smallest_three(values.quats)
    opacity, none = np.maximum(api.to_bytes(values.opacities * 255.0), 1), np.zeros(len(values))
    parts, color = api.to_bytes((others.T * np.sqrt(2.0) + 1.0) * 127.5), api.to_bytes(values.colors.T * 255.0)
    planes = [*(places >> 8), opacity, *(places & 255), stds, *scales.T, which, *parts, none, *color, none]
    legend = [1.0, 2.0] if std_m is None else np.quantile(std_m[shown], [0.02, 0.98]).tolist()
    return gzip.compress(np.stack(planes).astype(np.uint8).tobytes(), compresslevel=9, mtime=0), {
        "count": len(values), "shown": int(shown.sum()), "low": low.tolist(), "step": step, "scale": scale,
        "std": None if std_m is None else std, "legend": legend,
    }  # fmt: skip


def logarithmic(values: Doubles, smallest: float) -> tuple[NDArray[np.uint8], list[float]]:
    """Return the logarithms of values as bytes, and the logarithm of byte 0 and of a step."""
    logs = np.log(np.maximum(values, smallest))
    low, step = float(logs.min()), max(float(np.ptp(logs)), 1e-6) / 255.0
    return api.to_bytes((logs - low) / step), [low, step]


def page(title: str, subtitle: str, scene: dict[str, Any], data: bytes, poster: NDArray[np.floating[Any]]) -> str:
    """Return the page. poster [H, W, 3] in [0, 1]: shown until the splats are, and where no script runs."""
    picture = io.BytesIO()
    Image.fromarray(np.asarray(np.rint(poster * 255.0), np.uint8)).save(picture, "JPEG", quality=80)
    parts = {
        "title": html.escape(title), "subtitle": html.escape(subtitle),
        "poster": base64.b64encode(picture.getvalue()).decode(), "splats": base64.b64encode(data).decode(),
        "scene": json.dumps(scene, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "script": (HERE / "viewer.js").read_text(encoding="utf-8"),
    }  # fmt: skip
    template = (HERE / "viewer.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], template)
