"""Settle a field's Adam state with the compiled CPU kernels (native/adam.h)."""

from sigmasplat.data.field import Rows
from sigmasplat.fit.adam import BETA1, EPSILON, Rates


def settle(field: Rows, rates: Rates) -> None:
    """Settle the rows of a field's 17 columns, as `fit.adam.settle` does."""
    from sigmasplat.native import _core

    _core.adam_settle(
        field.params, field.moment1, field.moment2, field.last_step, rates.per_column.numpy(),
        BETA1, rates.beta2, EPSILON, field.steps,
    )  # fmt: skip
