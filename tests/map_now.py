"""Map a keyframe at once."""

from sigmasplat.fit.field import FieldFit
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.mapping.mapper import Mapper
from sigmasplat.render.view import View
from sigmasplat.types import Matrix, completed, never


def map_now(mapper: Mapper, view: View, index: int, target: Target, T_world_camera: Matrix) -> FieldFit:
    """Map a keyframe with both halves of its steps."""
    fit = completed(mapper.mapping(view, Keyframe(index, target, T_world_camera)))
    fit.join(completed(mapper._left_of_half(view, never)))
    return fit
