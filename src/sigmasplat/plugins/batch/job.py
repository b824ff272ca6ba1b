"""Describe one run of a batch: where its sequence is, its settings, its folder, and whether that folder is finished."""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import sigmasplat
import sigmasplat.api as api
from sigmasplat.api import Config, SigmaSplatError

FACT = "batch"
"""The entry of run.json that says which job a run folder belongs to."""


@dataclass(frozen=True)
class Job:
    """One run. `name` is that of its folder; `paths` are the places where its sequence may be, relative to the data;
    `given` names the settings that keep their values in every scene."""

    name: str
    paths: tuple[str, ...]
    config: Config
    mesh: bool = False
    given: tuple[str, ...] = ()

    def to_json(self) -> str:
        """Return the job as text, for another process."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> "Job":
        """Read a job from text."""
        values = json.loads(text)
        config, given = Config.from_dict(values["config"]), tuple(values["given"])
        return Job(values["name"], tuple(values["paths"]), config, values["mesh"], given)

    def sequence(self, data: str | None) -> str:
        """Return the path of the sequence below the folder `data`. Raises SourceError if it is not there."""
        if data is None:
            return self.paths[0]
        found = [place for place in (Path(data) / path for path in self.paths) if place.exists()]
        if not found:
            raise api.SourceError(f"no {self.paths[0]} in {data}")
        return str(found[0].resolve())

    def facts(self) -> dict[str, Any]:
        """Return what two runs must share to be the same job, beside their settings: code and scores."""
        return {"code": installed_code(), "mesh": self.mesh}

    def started_in(self, folder: Path) -> bool:
        """Return whether a folder has a run of this job, with the same settings, code and scores."""
        facts = _facts(folder)
        noted, used = facts.get(FACT), api.config_of_facts(facts, self.config, self.given)
        with suppress(SigmaSplatError):
            if isinstance(noted, dict) and self.facts().items() <= noted.items():
                return bool(api.read_json(folder / "config.json") == json.loads(json.dumps(used.to_dict())))
        return False

    def finished_in(self, folder: Path) -> bool:
        """Return whether a folder has the complete, scored run of this job."""
        return self.started_in(folder) and bool(_facts(folder)[FACT].get("scored"))


def has_other_run(job: Job, folder: Path) -> bool:
    """Return whether a folder has a run with other settings, code or scores than the job."""
    return bool(_facts(folder).get(FACT)) and not job.started_in(folder)


def _facts(folder: Path) -> Mapping[str, Any]:
    try:
        return api.RunFolder(folder).facts()
    except SigmaSplatError:
        return {}


@cache
def installed_code() -> str:
    """Return the digest of the installed code. Runs with other code are never mixed in one table."""
    return api.code_digest(Path(sigmasplat.__file__).parent, api.INSTALLED)
