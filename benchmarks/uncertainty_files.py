"""The folder of `uncertainty.py`: samples of each run, scores of all runs, pictures."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from uncertainty_samples import AWAY, Job, Kind, Measured, Study
from uncertainty_scores import Run, score_runs, sparsification_charts

import sigmasplat
from sigmasplat.errors import RunError
from sigmasplat.files import machine
from sigmasplat.files.atomic import make_folder, write_text
from sigmasplat.files.json_files import to_json, write_json
from sigmasplat.files.machine import INSTALLED, code_digest
from sigmasplat.files.tensors import open_tensors, write_tensors
from sigmasplat.plugins.outputs.drawing.plot import svg

MEASURED_BY = (
    "finished_run", "splat_statistics", "surface_errors", "surface_predictors", "uncertainty_samples", "unseen_views",
    "view_predictors",
)  # fmt: skip
"""The modules of this folder that decide the samples of a run."""
SCORES, SAMPLES = "uncertainty.json", "samples"


@dataclass(frozen=True, eq=False)
class StudyFolder:
    """The results of a study in a folder. Samples of a run are reused if settings, code and machine are the same."""

    path: Path
    study: Study

    @staticmethod
    def create(path: Path, study: Study) -> "StudyFolder":
        """Create the folder. Raises RunError if it cannot be written, or has files of something else."""
        if path.is_dir() and any(path.iterdir()) and not (path / SAMPLES).is_dir():
            raise RunError(f"{path} is not empty and not a folder of benchmarks/uncertainty.py; give another --runs")
        make_folder(path / SAMPLES)
        return StudyFolder(path, study)

    def conditions(self, job: Job) -> str:
        """Return what decides the samples of a run, as text."""
        facts = {
            "path": job.path,
            "config": job.config.to_dict(),
            "given": sorted(job.given),
            "views": self.study.views,
            "code": [code_digest(Path(sigmasplat.__file__).parent, INSTALLED), *map(_digest, MEASURED_BY)],
            "machine": machine.describe(),
        }
        return json.dumps(to_json(facts), sort_keys=True)

    def load(self, job: Job) -> Measured | None:
        """Return the stored samples of a run; None if there are none, or they were made under other conditions."""
        file = self._samples(job)
        if not file.exists():
            return None
        found = dict[Kind, dict[str, Any]]()
        with open_tensors(file, "samples") as tensors:
            text = tensors.metadata()
            if text.get("conditions") != self.conditions(job):
                return None
            for name in tensors.keys():  # noqa: SIM118
                *kind, column = name.split("|")
                found.setdefault(Kind(*kind), {})[column] = tensors.get_tensor(name).numpy()
        return Measured(json.loads(text["facts"]), found)

    def save(self, job: Job, measured: Measured) -> None:
        """Write the samples of a run. Raises RunError if they cannot be written."""
        tensors = {
            f"{kind.quantity}|{kind.map}|{kind.views}|{column}": torch.from_numpy(np.ascontiguousarray(values))
            for kind, columns in measured.samples.items()
            for column, values in columns.items()
        }
        text = {"conditions": self.conditions(job), "facts": json.dumps(to_json(measured.facts))}
        write_tensors(self._samples(job), tensors, text)

    def write(self, jobs: Sequence[Job], measured: Sequence[Measured]) -> list[dict[str, Any]]:
        """Score the runs, write scores and pictures, and return the runs as they are in the file."""
        scores = score_runs([Run(job.source, found.samples) for job, found in zip(jobs, measured, strict=True)])
        runs = [
            {"source": job.source, "path": job.path, "seed": job.seed, **found.facts, "scores": _nested(of_kind)}
            for job, found, of_kind in zip(jobs, measured, scores, strict=True)
        ]
        head = {
            "config": self.study.config.to_dict(),
            "hold_every": self.study.hold_every,
            "limit": self.study.limit,
            "commit": machine.code_version(),
            "machine": machine.describe(),
        }
        write_json(self.path / SCORES, head | {"runs": runs})
        for job, found in zip(jobs, measured, strict=True):
            for kind, arrays in found.samples.items():
                if not len(arrays["squared_error"]):
                    continue
                name = f"{_plain(job)}-{kind.quantity}-{kind.map}-{kind.views}".replace(" ", "-")
                for number, chart in enumerate(sparsification_charts(kind, arrays), 1):
                    write_text(self.path / f"{name}-{number}.svg", svg(chart))
        return runs

    def _samples(self, job: Job) -> Path:
        return self.path / SAMPLES / f"{_plain(job)}.safetensors"


def _nested(of_kind: dict[Kind, dict[str, Any]]) -> dict[str, Any]:
    """Return scores as quantity → map → views → pixels."""
    nested = dict[str, Any]()
    for kind, scores in sorted(
        of_kind.items(), key=lambda item: (item[0].quantity, item[0].map, item[0].views == AWAY)
    ):
        nested.setdefault(kind.quantity, {}).setdefault(kind.map, {})[kind.views] = scores
    return nested


def _plain(job: Job) -> str:
    """Return a name for the files of a run."""
    words = "".join(c if c.isalnum() else "-" for c in f"{job.source.rstrip('/').rpartition('/')[2]} seed{job.seed}")
    return "-".join(filter(None, words.lower().split("-")))


def _digest(module: str) -> str:
    return hashlib.sha256((Path(__file__).parent / f"{module}.py").read_bytes()).hexdigest()[:16]
