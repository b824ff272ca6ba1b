"""Fit the predicted depth of a frame before it is tracked, and again before it is mapped."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.render.view import View
from sigmasplat.tracking.predicted_depth_fit import DepthFit
from sigmasplat.tracking.prepared_frame import PreparedFrame, Splats
from sigmasplat.tracking.tracker import Tracker
from sigmasplat.types import Matrix

OPAQUE = 0.9
"""The map shows a surface where its alpha is above this."""


def fitted_to_map(tracker: Tracker, field: Splats, view: View, seen: PreparedFrame) -> PreparedFrame:
    """Return a frame whose depth agrees with the map at the pose where it is expected, and remember the fit; the same
    frame without `tracking.fit_depth`."""
    if not tracker.config.fit_depth:
        return seen
    T_world_camera = tracker.prediction(seen.frame.prior).predicted
    tracker.depth = _fitted(tracker.depth, field, view, seen, T_world_camera)
    return _with_fit(tracker.depth, seen)


def fitted_keyframe(
    tracker: Tracker, field: Splats, view: View, seen: PreparedFrame, T_world_camera: Matrix, connected: bool
) -> PreparedFrame:
    """Return a frame that is to be mapped with the depth that its tracked pose and the views of earlier keyframes
    show, and remember the fit; the same frame without `tracking.fit_depth`.

    T_world_camera [4, 4]: its pose; connected: whether it was tracked relative to the newest keyframe.
    """
    if not tracker.config.fit_depth:
        return seen
    depth, extractor, keyframe = tracker.depth, tracker.extractor, tracker.keyframe
    if not connected:
        depth = replace(depth, shape=depth.shape.without_views())
    if extractor is not None and seen.image is not None:
        hop = keyframe.T_camera_world @ T_world_camera if connected and keyframe is not None else np.eye(4)
        depth = replace(depth, shape=depth.shape.after(seen.image.with_depth(seen.frame.depth_m), hop, extractor))
    if connected:
        depth = _fitted(depth, field, view, seen, T_world_camera)
    tracker.depth = depth
    return _with_fit(depth, seen)


def _fitted(depth: DepthFit, field: Splats, view: View, seen: PreparedFrame, T_world_camera: Matrix) -> DepthFit:
    if not len(field.params):
        return depth
    return depth.fitted(seen.frame.depth_m, _depth_of_map(field, view, T_world_camera))


def _depth_of_map(field: Splats, view: View, T_world_camera: Matrix) -> NDArray[np.float32]:
    """Return the depth of the map from a camera [H, W], m; 0 where it is not opaque."""
    camera = view.camera
    view.forward(field.params, se3.inverse(T_world_camera))
    alpha, depth = (plane[: camera.height, : camera.width].cpu().numpy() for plane in (view.alpha, view.sums[3]))
    return np.where(alpha > OPAQUE, depth / np.maximum(alpha, np.float32(OPAQUE)), np.float32(0.0))


def _with_fit(depth: DepthFit, seen: PreparedFrame) -> PreparedFrame:
    return seen.with_depth(depth.applied(seen.frame.depth_m))
