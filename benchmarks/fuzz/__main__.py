"""`python -m benchmarks.fuzz`: fuzz the readers for some time, and list what was found."""

import argparse
import json
import sys
import time
from collections import Counter
from pathlib import Path

from benchmarks.fuzz.run import Limits, again, fuzz
from benchmarks.fuzz.targets import TARGETS


def earlier(log: Path | None, seed: int) -> Counter[str]:
    """Inputs of each target that a log has with this seed, counted from 0 without a gap."""
    done: Counter[str] = Counter()
    if log is not None and log.is_file():
        for line in log.read_text().splitlines():
            batch = json.loads(line)
            if batch["seed"] == seed and batch["first"] == done[batch["target"]]:
                done[batch["target"]] += batch["inputs"]
    return done


def main() -> int:
    """Parse, fuzz, print; exit code 1 where something was found."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="time to fuzz (60)")
    parser.add_argument("--inputs", type=int, help="end after so many, shared out by the targets")
    parser.add_argument("--workers", type=int, default=1, help="processes side by side (1)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the mutations (0)")
    parser.add_argument("--only", nargs="+", choices=TARGETS, default=list(TARGETS))
    parser.add_argument("--log", type=Path, help="append counts and findings; what is "
                        "in it with the same seed is not read again")  # fmt: skip
    parser.add_argument("--corpus", type=Path, help="keep the valid files here for the next run")
    parser.add_argument("--input", type=int, help="read this one input of --only again")
    parser.add_argument("--keep", type=Path, help="with --input: keep its files here")
    given = parser.parse_args()
    if given.input is not None:
        again(given.only[0], given.seed, given.input, given.keep)
        return 0
    limits, began = Limits(), time.monotonic()
    counts, done, spent = Counter(), earlier(given.log, given.seed), Counter()
    planned = None
    if given.inputs is not None:
        shares = {name: TARGETS[name].inputs for name in given.only}
        planned = {
            n: -(-given.inputs * share // sum(shares.values())) for n, share in shares.items()
        }
    found: dict[tuple, list[dict]] = {}

    def note(batch: dict) -> None:
        counts[batch["target"]] += batch["inputs"]
        spent[batch["target"]] += batch["seconds"]
        for finding in batch["findings"]:
            key = tuple(finding[name] for name in ("target", "kind", "type", "place"))
            found.setdefault(key, []).append(finding)
            if len(found[key]) == 1:
                print(f"{finding['kind']} in {finding['target']}: {finding['type']} at "
                      f"{finding['place']}: {finding['message'][:150]} "
                      f"(--only {finding['target']} --seed {given.seed} --input "
                      f"{finding['input']})", flush=True)  # fmt: skip
        if given.log:
            with given.log.open("a") as file:
                file.write(json.dumps(batch | {"seed": given.seed}) + "\n")

    fuzz(
        given.only,
        given.seconds,
        given.workers,
        given.seed,
        limits,
        note,
        planned,
        done,
        given.corpus,
    )
    seconds = time.monotonic() - began
    print(f"{sum(counts.values()):,} inputs in {seconds:.0f} s, seed {given.seed}:")
    for name in given.only:
        here = [key for key in found if key[0] == name]
        rate = counts[name] / max(spent[name], 1e-9)
        print(f"  {name:12} {counts[name]:9,} inputs ({rate:6.0f}/s), {len(here)} findings")
    if done:
        print(f"with those in {given.log}: {sum(counts.values()) + sum(done.values()):,} inputs")
    return 1 if found else 0


sys.exit(main())
