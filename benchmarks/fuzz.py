"""Run the public commands on mutated inputs of every format and count how they end.

Every input must be refused in one line with exit code 2, or be used without harm. Failures are tracebacks, more than
10 s of processor time, and more than 1 GB of memory. The inputs follow from the seed. `tests/errors/test_fuzz.py` runs
the first ones and the corpus of past failures.
"""

import argparse
import json
import multiprocessing
import os
import random
import sys
import tempfile
import time
import traceback
from collections import Counter
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tests"))
os.environ |= {"OMP_NUM_THREADS": "1", "SIGMASPLAT_THREADS": "1"}  # a fork has none of its parent's threads

import record  # noqa: E402

import fuzz_server  # noqa: E402
from fuzz_corpus import cases, read, save  # noqa: E402
from fuzz_mutations import mutated  # noqa: E402
from fuzz_samples import Sample, samples  # noqa: E402


def main() -> None:
    """Run the inputs, print each failure once, and write the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20_000, help="number of inputs")
    parser.add_argument("--minutes", type=float, default=1e9, help="stop after this time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    parser.add_argument("--only", default="", help="samples whose names contain this text")
    parser.add_argument("--keep", type=Path, help="folder for one input of each kind of failure, as in tests/corpus")
    parser.add_argument("--corpus", action="store_true", help="run the past failures instead of new inputs")
    parser.add_argument("--quiet", action="store_true", help="write no results")
    given = parser.parse_args()
    fuzz_server.warm_up()
    if given.corpus:
        sys.exit(_failures_of_corpus())
    started_s = time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        found = samples(Path(temporary) / "samples")
        part = partial(_run_part, given, [s for s in found if given.only in s.name], Path(temporary), started_s)
        with multiprocessing.get_context("fork").Pool(given.jobs) as pool:
            by_sample = _added(pool.map(part, range(given.jobs), chunksize=1))
    counts, seconds = sum(by_sample.values(), Counter()), round(time.monotonic() - started_s, 1)
    print(json.dumps({"inputs": counts.total(), **counts, "seconds": seconds}))
    if not given.quiet:
        kinds = (fuzz_server.REFUSED, fuzz_server.HARMLESS, *fuzz_server.FAILURES)
        figures = {
            "inputs": counts.total(), "seconds": seconds, "seed": given.seed, **{kind: counts[kind] for kind in kinds},
            "samples": {name: dict(sorted(each.items())) for name, each in sorted(by_sample.items())},
        }  # fmt: skip
        record.write(record.results("fuzz", figures, seeds=[given.seed]))
    sys.exit(bool(sum(counts[kind] for kind in fuzz_server.FAILURES)))


def _run_part(
    given: argparse.Namespace, found: list[Sample], folder: Path, started_s: float, job: int
) -> dict[str, Counter[str]]:
    """Run every `jobs`-th input, print failures that this job sees for the first time, and count the endings."""
    by_sample, seen, weights = dict[str, Counter[str]](), set[str](), [sample.weight for sample in found]
    for number in range(job, given.count, given.jobs):
        if time.monotonic() - started_s > 60 * given.minutes:
            break
        rng = random.Random(f"{given.seed}/{number}")
        sample = rng.choices(found, weights)[0]
        command, files = rng.choice(sample.commands), mutated(sample.files, rng)
        ending = fuzz_server.run_files(sample, files, command, folder / f"case-{number}")
        by_sample.setdefault(sample.name, Counter())[ending.kind] += 1
        if ending.kind in fuzz_server.FAILURES and (what := _signature(ending)) not in seen:
            seen.add(what)
            cost = f"{ending.cpu_s:.1f} s, {ending.peak_bytes / 1e6:.0f} MB"
            print(f"#{number} {sample.name} {' '.join(command)}: {ending.kind}, exit {ending.code}, {cost}")
            print(f"{ending.error[-1800:]}\n", flush=True)
            if given.keep:
                save(given.keep / f"{sample.name}-{given.seed}-{number}.zip", sample, files, command)
    return by_sample


def _added(parts: list[dict[str, Counter[str]]]) -> dict[str, Counter[str]]:
    """Add the counts of all jobs."""
    total = dict[str, Counter[str]]()
    for part in parts:
        for name, counts in part.items():
            total.setdefault(name, Counter()).update(counts)
    return total


def _failures_of_corpus() -> int:
    """Run the inputs of past failures and print those that fail; return their number."""
    failures = 0
    with tempfile.TemporaryDirectory() as temporary:
        found = {sample.name: sample for sample in samples(Path(temporary) / "samples")}
        for path in cases():
            ending = fuzz_server.run_files(*read(path, found), Path(temporary) / path.stem)
            if ending.kind in fuzz_server.FAILURES:
                failures += 1
                print(f"{path.stem}: {ending.kind}, exit {ending.code}\n{ending.error[-1800:]}", flush=True)
    return failures


def _signature(ending: fuzz_server.Ending) -> str:
    """Name the place of a failure: the last lines of a traceback, without values."""
    places = [line.strip() for line in ending.error.splitlines() if line.strip().startswith("File ")]
    return f"{ending.kind} {places[-3:] if places else ending.error[:60]}"


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        traceback.print_exc(limit=0)
