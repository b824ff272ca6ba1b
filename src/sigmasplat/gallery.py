"""Draw the strips that a run's page shows."""

from sigmasplat.io.runs import RunFolder
from sigmasplat.metrics.panels import View, side_by_side


class Gallery:
    """Draw the strips of a few views of each kind into images/ and remember their names for the report."""

    def __init__(self, run: RunFolder, per_kind: int) -> None:
        """Start empty; strips of an earlier evaluation are removed, since the views may differ."""
        self.run, self.per_kind = run, per_kind
        self.strips: dict[str, list[str]] = {}
        for old in run.images.glob("view-*.png"):
            old.unlink()

    def add(self, view: View, place: str = "") -> None:
        """Draw one view; `place` says in which map it was seen if not in the final one."""
        name = f"view-{view.kind.replace(' ', '-')}{place and '-submap'}-{view.index:06d}.png"
        self.run.write_image(name, side_by_side(view))
        self.strips.setdefault(f"{view.kind} views{place}", []).append(f"images/{name}")
