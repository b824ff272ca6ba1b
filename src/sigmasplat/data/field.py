"""Store the Gaussians: one row per splat. Parameters and optimiser state are always edited together."""

from collections.abc import Iterable
from dataclasses import dataclass, field as dataclass_field, replace

import numpy as np
import torch
from torch import Tensor

from sigmasplat.data import harmonics, se3
from sigmasplat.errors import SigmaSplatError

COLUMNS: dict[str, slice] = {
    "means": slice(0, 3),
    "quats": slice(3, 7),
    "log_scales": slice(7, 10),
    "opacity_logits": slice(10, 11),
    "colors": slice(11, 14),
    "log_variances": slice(14, 17),
}
WIDTH = 17
INITIAL_LOG_VARIANCE = -7.0
"""s₀ (VarSplat §1)."""
ATTRIBUTES = {"harmonics": 45}
"""Optional attributes of splats, with their number of columns.

harmonics: spherical harmonics of degrees 1 to 3, in the order of `data.harmonics.basis`, with red, green and blue of
each: columns 3·i + channel.
"""


@dataclass(eq=False)
class Rows:
    """Parameters [N, m] of N splats with Adam's state: moments of the same shape; `last_step` [N] int32, the step that
    last moved each row; `steps`, the number of Adam steps."""

    params: Tensor
    moment1: Tensor = dataclass_field(default_factory=lambda: torch.empty(0))
    moment2: Tensor = dataclass_field(default_factory=lambda: torch.empty(0))
    last_step: Tensor = dataclass_field(default_factory=lambda: torch.empty(0, dtype=torch.int32))
    steps: int = 0

    def __post_init__(self) -> None:
        if self.moment1.shape != self.params.shape:
            self.moment1 = torch.zeros_like(self.params)
        if self.moment2.shape != self.params.shape:
            self.moment2 = torch.zeros_like(self.params)
        if len(self.last_step) != len(self.params) or self.last_step.device != self.params.device:
            self.last_step = torch.zeros(len(self.params), dtype=torch.int32, device=self.params.device)

    def __len__(self) -> int:
        return len(self.params)

    def copy_to(self, device: torch.device) -> "Rows":
        """Return copies of these rows on a device."""
        params, moment1, moment2, last_step = (x.to(device, copy=True) for x in self._tensors)
        return Rows(params, moment1, moment2, last_step, self.steps)

    def take(self, other: "Rows") -> None:
        """Copy the state of the same rows from another object, from any device."""
        for mine, theirs in zip(self._tensors, other._tensors, strict=True):
            mine.copy_(theirs)
        self.steps = other.steps

    def forget(self) -> None:
        """Start Adam again: zero moments, no step taken."""
        self.moment1.zero_()
        self.moment2.zero_()
        self.last_step.zero_()
        self.steps = 0

    @property
    def _tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.params, self.moment1, self.moment2, self.last_step

    def join(self, other: "Rows") -> None:
        """Append the rows of another object, from any device, with their optimiser state."""
        more = zip(self._tensors, other._tensors, strict=True)
        self.params, self.moment1, self.moment2, self.last_step = (
            torch.cat([mine, theirs.to(mine.device)]) for mine, theirs in more
        )

    def choose(self, rows: Tensor) -> None:
        """Keep the rows selected by a bool mask [N] or an index tensor."""
        rows = rows.nonzero().squeeze(1) if rows.dtype == torch.bool else rows
        self.params, self.moment1, self.moment2, self.last_step = (
            tensor.index_select(0, rows)  # several times as fast as tensor[rows]
            for tensor in self._tensors
        )


def _without_optimiser_state(params: Tensor) -> Rows:
    """Return rows in host memory whose moments take no RAM until they are written: a map that is only saved has no use
    for them."""
    moment1, moment2 = (torch.from_numpy(np.zeros(tuple(params.shape), np.float32)) for _ in range(2))
    return Rows(params, moment1.to(params.dtype), moment2.to(params.dtype))


@dataclass(eq=False)
class GaussianField(Rows):
    """N splats as one float32 tensor `params` [N, 17], columns named in `COLUMNS`.

    means: metres, world (or submap) frame; quats: wxyz, any positive norm; log_scales: log metres; opacity_logits:
    logit of opacity; colors: RGB in [0, 1]; log_variances: log σ² of observed colour about `colors` (VarSplat §1, s).
    `attributes` contains rows that only some maps need, by name (`ATTRIBUTES`). `ids` [N] int64 identify splats,
    whatever row they are in; `next_id` is the id of the next new splat.
    """

    attributes: dict[str, Rows] = dataclass_field(default_factory=dict)
    ids: Tensor = dataclass_field(default_factory=lambda: torch.empty(0, dtype=torch.int64))
    next_id: int = 0

    def __post_init__(self) -> None:
        if self.params.ndim != 2 or self.params.shape[1] != WIDTH:
            raise SigmaSplatError(f"a field needs params [N, {WIDTH}], found {tuple(self.params.shape)}")
        super().__post_init__()
        if len(self.ids) != len(self.params) or self.ids.device != self.params.device:
            self.ids, self.next_id = torch.arange(len(self.params), device=self.params.device), len(self.params)

    @staticmethod
    def empty() -> "GaussianField":
        """Make a field without splats."""
        return GaussianField(torch.zeros(0, WIDTH))

    @staticmethod
    def side_by_side(fields: Iterable["GaussianField"]) -> "GaussianField":
        """Return the splats of fields in their order, with new ids and without optimiser state, in host memory.

        The sum may be many times larger than any map that is fitted: each part is copied once, into one tensor.
        """
        params, attributes, count = [torch.zeros(0, WIDTH)], dict[str, list[tuple[int, Tensor]]](), 0
        for part in filter(len, fields):
            params.append(part.params.cpu())
            for name, attribute in part.attributes.items():
                attributes.setdefault(name, []).append((count, attribute.params))
            count += len(part)
        joined = _without_optimiser_state(torch.cat(params))
        field = GaussianField(joined.params, joined.moment1, joined.moment2)
        for name, parts in attributes.items():
            rows = torch.zeros(count, ATTRIBUTES[name])
            for first, values in parts:
                rows[first : first + len(values)] = values
            field.attributes[name] = _without_optimiser_state(rows)
        return field

    @staticmethod
    def from_values(
        means: Tensor, scales: Tensor, colors: Tensor, *, quats: Tensor | None = None, opacities: Tensor | float = 0.5,
        log_variances: Tensor | float = INITIAL_LOG_VARIANCE,
    ) -> "GaussianField":  # fmt: skip
        """Build a field from activated values: means [N, 3] m, scales [N, 3] or [N] m, colors [N, 3].

        log_variances defaults to s₀ = −7 (VarSplat §1).
        """
        params = means.new_zeros(len(means), WIDTH)
        params[:, COLUMNS["means"]] = means
        params[:, 3] = 1.0
        if quats is not None:
            params[:, COLUMNS["quats"]] = quats
        params[:, COLUMNS["log_scales"]] = (scales if scales.ndim == 2 else scales[:, None]).log()
        opacity = torch.as_tensor(opacities, dtype=means.dtype, device=means.device).reshape(-1, 1)
        params[:, COLUMNS["opacity_logits"]] = torch.logit(opacity)
        params[:, COLUMNS["colors"]] = colors
        params[:, COLUMNS["log_variances"]] = torch.as_tensor(log_variances, dtype=means.dtype)
        return GaussianField(params)

    @property
    def means(self) -> Tensor:
        """Return positions [N, 3], metres."""
        return self.params[:, COLUMNS["means"]]

    @property
    def quats(self) -> Tensor:
        """Return rotations [N, 4], wxyz, not normalised."""
        return self.params[:, COLUMNS["quats"]]

    @property
    def scales(self) -> Tensor:
        """Return standard deviations along the axes [N, 3], metres."""
        return self.params[:, COLUMNS["log_scales"]].exp()

    @property
    def opacities(self) -> Tensor:
        """Return opacities [N] in (0, 1)."""
        return torch.sigmoid(self.params[:, 10])

    @property
    def colors(self) -> Tensor:
        """Return mean colours [N, 3]."""
        return self.params[:, COLUMNS["colors"]]

    @property
    def variances(self) -> Tensor:
        """Return appearance variances σ² [N, 3] (VarSplat §1)."""
        return self.params[:, COLUMNS["log_variances"]].exp()

    def get_or_create(self, name: str) -> Rows:
        """Return an attribute by its name; if the field does not have it yet, it is created as zeros."""
        if name not in self.attributes:
            self.attributes[name] = Rows(self.params.new_zeros(len(self), ATTRIBUTES[name]))
        return self.attributes[name]

    def append(self, other: "GaussianField") -> None:
        """Append another field's splats, from any device, with new ids. An attribute that only one of the fields has is
        0 for the splats of the other."""
        if not len(other):
            return
        for name in {**self.attributes, **other.attributes}:
            self.get_or_create(name).join(other.get_or_create(name))
        self.ids = torch.cat([self.ids, torch.arange(self.next_id, self.next_id + len(other), device=self.ids.device)])
        self.next_id += len(other)
        self.join(other)

    def copy_to(self, device: torch.device) -> "GaussianField":
        """Return a copy of the field on a device, including attributes and ids."""
        attributes = {name: attribute.copy_to(device) for name, attribute in self.attributes.items()}
        rows = super().copy_to(device)
        return GaussianField(*rows._tensors, rows.steps, attributes, self.ids.to(device), self.next_id)

    def to(self, device: torch.device) -> "GaussianField":
        """Return the field itself if it is already on a device, else a copy on it."""
        return self if self.params.device == device else self.copy_to(device)

    def forget(self) -> None:
        """Start Adam again: zero moments, no step taken, for attributes too."""
        super().forget()
        for attribute in self.attributes.values():
            attribute.forget()

    def keep(self, rows: Tensor) -> None:
        """Keep the splats selected by a bool mask [N] or an index tensor."""
        if rows.dtype == torch.bool:
            rows = rows.nonzero().squeeze(1)  # once for all parts: on a device the host waits for the number of rows
            if len(rows) == len(self):
                return
        for part in (self, *self.attributes.values()):
            part.choose(rows)
        self.ids = self.ids[rows]

    def part(self, rows: Tensor) -> "GaussianField":
        """Return copies of the splats selected by a bool mask [N], with their ids and optimiser state."""
        kept = replace(self, attributes={name: replace(attribute) for name, attribute in self.attributes.items()})
        kept.keep(rows)
        return kept if len(kept) < len(self) else self.copy_to(self.params.device)

    def moved(self, T_new_old: Tensor) -> "GaussianField":
        """Return the field moved by a rigid 4×4 transform: positions and rotations change, shapes and colours do not.

        View-dependent colours rotate with the field, and so do Adam's moments. The second moments rotate as if the
        components of a gradient were independent.
        """
        T, new = T_new_old.to(self.params), self.copy_to(self.params.device)
        for name, matrix in (("means", T[:3, :3]), ("quats", left_factor(quaternion_of(T[:3, :3])))):
            columns = COLUMNS[name]
            for rows, by in ((new.params, matrix), (new.moment1, matrix), (new.moment2, matrix**2)):
                rows[:, columns] = transformed(rows[:, columns], by)
        new.means.add_(T[:3, 3])
        if "harmonics" in new.attributes:
            new.attributes["harmonics"].params = harmonics.turned(new.attributes["harmonics"].params, T[:3, :3])
        return new


def quaternion_of(R: Tensor) -> Tensor:
    """Convert a 3×3 rotation tensor to a unit quaternion wxyz."""
    return torch.as_tensor(se3.quaternion_from_rotation(R.detach().cpu().double().numpy())).to(R)


def left_factor(quaternion: Tensor) -> Tensor:
    """Return the matrix [4, 4] of multiplication by a quaternion wxyz from the left."""
    w, x, y, z = quaternion
    rows = [(w, -x, -y, -z), (x, w, -z, y), (y, z, w, -x), (z, -y, x, w)]
    return torch.stack([torch.stack(row) for row in rows])


def transformed(rows: Tensor, matrix: Tensor) -> Tensor:
    """Return rows [N, m] times matrixᵀ [m, m], column by column. The rounding of a library's matrix product depends on
    memory alignment."""
    return sum((rows[:, k, None] * matrix[:, k] for k in range(len(matrix))), torch.zeros_like(rows))
