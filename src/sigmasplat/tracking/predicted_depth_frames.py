"""Fit the predicted depth of a frame before it is tracked, and again before it is mapped."""

from dataclasses import replace

import numpy as np
from torch import Tensor

from sigmasplat.data import se3
from sigmasplat.fit.pose import OPAQUE
from sigmasplat.render.view import View
from sigmasplat.tracking.predicted_depth_fit import DepthFit
from sigmasplat.tracking.prepared_frame import PreparedFrame
from sigmasplat.tracking.tracker import Tracker
from sigmasplat.types import Matrix


def fitted_to_map(tracker: Tracker, params: Tensor, view: View, seen: PreparedFrame) -> PreparedFrame:
    """Return a frame whose depth agrees with the map at the pose where it is expected, and remember the fit; the same
    frame without `tracking.fit_depth`. params: rows [N, 17] of the map."""
    if not tracker.config.fit_depth:
        return seen
    T_world_camera = tracker.prediction(seen).predicted
    tracker.depth = _fitted(tracker.depth, params, view, seen, T_world_camera)
    return seen.with_depth(tracker.depth.applied(seen.frame.depth_m))


def fitted_keyframe(
    tracker: Tracker, params: Tensor, view: View, seen: PreparedFrame, T_world_camera: Matrix, connected: bool
) -> PreparedFrame:
    """Return a frame that is to be mapped with the depth that its tracked pose and the views of earlier keyframes
    show, and remember the fit; the same frame without `tracking.fit_depth`.

    T_world_camera [4, 4]: its pose; connected: whether it was tracked relative to the newest keyframe.
    """
    if not tracker.config.fit_depth:
        return seen
    depth, extractor, keyframe = tracker.depth, tracker.extractor, tracker.keyframe
    if not connected:  # the motion since the last keyframe is not known
        depth = replace(depth, shape=replace(depth.shape, views=()))
    if extractor is not None and seen.image is not None:
        hop = keyframe.T_camera_world @ T_world_camera if connected and keyframe is not None else np.eye(4)
        depth = replace(depth, shape=depth.shape.after(seen.image.with_depth(seen.frame.depth_m), hop, extractor))
    if connected:
        depth = _fitted(depth, params, view, seen, T_world_camera)
    tracker.depth = depth
    return seen.with_depth(depth.applied(seen.frame.depth_m))


def _fitted(depth: DepthFit, params: Tensor, view: View, seen: PreparedFrame, T_world_camera: Matrix) -> DepthFit:
    """Return the fit of a frame to the depth of the map from a camera, where the map is opaque."""
    if not len(params):
        return depth
    camera = view.camera
    view.forward(params, se3.inverse(T_world_camera))
    alpha, surface = (plane[: camera.height, : camera.width].cpu().numpy() for plane in (view.alpha, view.sums[3]))
    known_m = np.where(alpha > OPAQUE, surface / np.maximum(alpha, np.float32(OPAQUE)), np.float32(0.0))
    return depth.fitted(seen.frame.depth_m, known_m)
