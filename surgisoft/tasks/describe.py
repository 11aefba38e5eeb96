"""Reference of the environments, made from their code: observations, actions, rewards, ends.

`describe` gives the facts of one task, `pages` a Markdown page for each, which stand in
`docs/environments`. To write them: `python -m surgisoft.tasks.describe docs/environments`; with
`--check` nothing is written, and pages that differ are named.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import sys
import textwrap
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from surgisoft.config import to_table, write_atomically
from surgisoft.errors import InputError
from surgisoft.tasks.base import DocumentedTask, Episodes, Signal, term_names
from surgisoft.tasks.observations import OBSERVATION_LIMIT
from surgisoft.tasks.registry import TASKS, make_task, spec_of

COMMAND = "python -m surgisoft.tasks.describe docs/environments"
"""What writes the pages."""


FAILS = (
    "In every task an episode also terminates, with `failed` in its info, if an arm is no longer "
    "finite, as after an action of NaN; its observations and rewards are then 0."
)
"""How an episode of any task can end, too."""
INFOS = (
    "The info of a step holds those that apply (`info.get(NAME)` is None for another); vector "
    "environments of Gymnasium mark them by `_NAME`, and in `batched_env` the others are NaN."
)
"""Where measures are."""


@dataclass(frozen=True)
class ObservedBlock:
    """A named stretch of an agent's observation."""

    name: str
    """Name of the block."""
    first: int
    """Index of its first entry."""
    last: int
    """Index of its last entry."""
    unit: str
    """Unit of x before scaling; `-` where it has none."""
    scale: str
    """The observed value as a function of x."""
    low: float
    """Lowest observed value, noise left aside."""
    high: float
    """Highest observed value, noise left aside."""
    meaning: str
    """What is observed."""

    @property
    def index(self) -> str:
        """Its entries, such as `12-14`, or `27` for one."""
        return f"{self.first}" if self.first == self.last else f"{self.first}-{self.last}"

    @property
    def range(self) -> str:
        """Its range, such as `-1..1`."""
        return f"{self.low:g}..{self.high:g}"


@dataclass(frozen=True)
class RewardTerm:
    """A term of an agent's reward."""

    name: str
    """Name, as in infos and metrics."""
    weight: float
    """Factor of the term."""
    meaning: str
    """The term before weighting."""


@dataclass(frozen=True)
class AgentDescription:
    """Observations, actions and rewards of one agent."""

    observation: tuple[ObservedBlock, ...]
    """Blocks in order."""
    chambers: int
    """Entries of an action: changes of the commanded pressures, kPa."""
    step_kPa: float
    """Largest change of a command in a step, kPa."""
    rewards: tuple[RewardTerm, ...]
    """Terms of the reward, summed in every step."""
    symbols: str
    """Meaning of the symbols in the terms."""

    @property
    def width(self) -> int:
        """D, entries of the observation."""
        return self.observation[-1].last + 1


@dataclass(frozen=True)
class Setting:
    """A field of a configuration."""

    name: str
    """Name of the field, with dots for parts of the config."""
    value: Any
    """Value of the field."""
    meaning: str
    """The docstring under the field, with its unit."""


@dataclass(frozen=True)
class TaskDescription:
    """The facts of a task with its default config, or with the one given."""

    name: str
    """Name in the registry."""
    summary: str
    """First sentence of the task's module or builder."""
    agents: dict[str, AgentDescription]
    """Each agent by name."""
    dt_s: float
    """Duration of a step, s."""
    steps: int
    """Steps after which an episode is truncated."""
    ends: str
    """When the task terminates an episode before that."""
    settings: tuple[Setting, ...]
    """Fields of the task's config, without reward weights and `world`."""
    randomisation: tuple[Setting, ...]
    """Domain randomization: fields of `config.world.randomisation`."""
    observer: tuple[Setting, ...]
    """State observer: fields of `config.world.observer`."""
    signals: tuple[Signal, ...] = ()
    """What an exported controller has to be given beside pressures and key points."""
    measures: tuple[str, ...] = ()
    """Names of the measures, with units, as in infos."""
    measured: str = ""
    """What the measures are."""


def describe(name: str, config: Any = None) -> TaskDescription:
    """The facts of the named task; it is built, and started once, to know its sizes."""
    spec = spec_of(name)
    task = make_task(name, config)
    episodes = Episodes(task)
    start = episodes.seeded(0, 1)
    still = {agent: torch.zeros(1, task.world.arms[agent].chambers) for agent in task.agents}
    _, outcome = episodes.step(start, still)
    return TaskDescription(
        name=name,
        summary=_summary(spec.build),
        agents=describe_agents(task),
        dt_s=task.world.config.dt_s,
        steps=task.steps,
        ends=_first(task.ended),
        settings=tuple(_settings(spec.config if config is None else config)),
        randomisation=tuple(_settings(task.world.config.randomisation)),
        observer=tuple(_settings(task.world.config.observer)),
        signals=getattr(task, "signals", ()),
        measures=tuple(outcome.measures),
        measured=" ".join((inspect.getdoc(task.measures) or "").split()),
    )


def describe_agents(task: DocumentedTask) -> dict[str, AgentDescription]:
    """Observations, actions and rewards of each agent of a task, by name."""
    blocks = task.blocks(Episodes(task).seeded(0, 1))
    return {agent: _agent(task, agent, blocks[agent]) for agent in task.agents}


def field_docs(kind: type) -> dict[str, str]:
    """The docstring under each field of a dataclass, and of those it extends, on one line."""
    docs: dict[str, str] = {}
    for one in reversed(kind.__mro__):
        if dataclasses.is_dataclass(one):
            docs.update(_own_field_docs(one))
    return {f.name: docs.get(f.name, "") for f in dataclasses.fields(kind)}


def _own_field_docs(kind: type) -> Iterator[tuple[str, str]]:
    """Name and docstring of each field that stands in the body of a dataclass."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(body, ast.ClassDef)
    field = None
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            field = node.target.id
        elif isinstance(node, ast.Expr) and field and isinstance(node.value, ast.Constant):
            yield field, " ".join(str(node.value.value).split())
            field = None


def pages() -> dict[str, str]:
    """The reference as Markdown: name of a file in `docs/environments` -> its content."""
    described = [describe(name) for name in TASKS]
    rows = [
        f"| [`{task.name}`]({task.name}.md) | {', '.join(task.agents)} | {task.summary} |"
        for task in described
    ]
    index = [
        "# Environments",
        "",
        f"Pages of this folder are made from the code by `{COMMAND}`.",
        "",
        "| task | agents | goal |",
        "|---|---|---|",
        *rows,
    ]
    found = {"index.md": "\n".join([*index, ""])}
    return found | {f"{task.name}.md": _page(task) for task in described}


def write_pages(folder: Path) -> list[Path]:
    """Write the pages to a folder; returns their files."""
    made = pages()
    for name, text in made.items():
        write_atomically(folder / name, text)
    return [folder / name for name in made]


def outdated(folder: Path) -> list[str]:
    """Names of the files in a folder that differ from the pages, or are missing, or too many."""
    made = pages()
    there = {file.name: file.read_text(encoding="utf-8") for file in folder.glob("*.md")}
    return sorted(name for name in made | there if made.get(name) != there.get(name))


def _settings(config: Any, prefix: str = "") -> Iterator[Setting]:
    """The fields of a config and of its parts, but for `weights` and `world`."""
    docs = field_docs(type(config))
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), f"{prefix}{field.name}"
        if field.name in ("weights", "world"):
            continue
        if dataclasses.is_dataclass(value):
            yield from _settings(value, f"{name}.")
        else:
            yield Setting(name, _shown(value), docs[field.name])


def _shown(value: Any) -> Any:
    """A value for a table; of a path, which differs between machines, only the last part."""
    return value.name if isinstance(value, Path) else to_table(value)


def _agent(task: DocumentedTask, agent: str, blocks) -> AgentDescription:
    observed, first = [], 0
    for block, value in blocks.items():
        size = value.shape[1]
        if size:
            last = first + size - 1
            observed.append(
                ObservedBlock(
                    block.name,
                    first,
                    last,
                    block.unit,
                    block.scale,
                    block.low,
                    block.high,
                    block.meaning,
                )
            )
        first += size
    weights, arm = task.weights[agent], task.world.arms[agent]
    meanings = field_docs(type(weights))
    return AgentDescription(
        observation=tuple(observed),
        chambers=arm.chambers,
        step_kPa=arm.pneumatics.step_kPa,
        rewards=tuple(
            RewardTerm(term, getattr(weights, term), meanings[term]) for term in term_names(weights)
        ),
        symbols=_first(weights),
    )


def _summary(build: Any) -> str:
    """First sentence of a builder's docstring, or of its module's where the builder is a class."""
    return _first(inspect.getmodule(build) if inspect.isclass(build) else build)


def _first(documented: Any) -> str:
    """First paragraph of a docstring, on one line."""
    return " ".join((inspect.getdoc(documented) or "").split("\n\n")[0].split())


def _page(task: TaskDescription) -> str:
    time_s = task.dt_s * task.steps
    lines = [
        f"# `{task.name}`",
        "",
        task.summary,
        "",
        "```python",
        *_made(task),
        "```",
        "",
        f"An episode is truncated after {task.steps} steps of {task.dt_s:g} s ({time_s:g} s). "
        f"Termination: {task.ends[0].lower()}{task.ends[1:]} {FAILS}",
        "",
        "Numbers are those of the default configuration and arm model; "
        f'`surgisoft.tasks.describe.describe("{task.name}", config)` gives those of others.',
        "",
    ]
    for name, agent in task.agents.items():
        lines += _agent_section(name, agent)
    lines += [
        "## Measures",
        "",
        f"{', '.join(f'`{name}`' for name in task.measures)}. {INFOS}",
        "",
        task.measured,
        "",
    ]
    lines += ["## Configuration", "", *_table(task.settings)]
    lines += ["## Domain randomization", "", "Fields of `world.randomisation`.", ""]
    lines += _table(task.randomisation)
    lines += ["## State observer", "", "Fields of `world.observer`.", "", *_table(task.observer)]
    if task.signals:
        lines += [
            "## Signals of an exported controller",
            "",
            "What a [controller](../export.md) has to be given beside pressures and key points.",
            "",
            "| signal | unit | range | meaning |",
            "|---|---|---|---|",
            *(
                f"| `{each.name}` | {each.unit} | {each.low:g}..{each.high:g} | {each.meaning} |"
                for each in task.signals
            ),
            "",
        ]
    return "\n".join(lines)


def _made(task: TaskDescription) -> list[str]:
    """Lines of Python that make the environment."""
    if len(task.agents) > 1:
        return [
            "import surgisoft",
            "",
            f'env = surgisoft.parallel_env("{task.name}")  # PettingZoo ParallelEnv',
        ]
    return [
        "import gymnasium",
        "import surgisoft",
        "",
        f'env = gymnasium.make("surgisoft/{task.name}-v0")',
        f'envs = gymnasium.make_vec("surgisoft/{task.name}-v0", num_envs=64)',
        f'parallel = surgisoft.parallel_env("{task.name}")  # PettingZoo ParallelEnv',
    ]


def _agent_section(name: str, agent: AgentDescription) -> list[str]:
    last, limit = agent.chambers - 1, f"{agent.step_kPa:g}"
    return [
        f"## Agent `{name}`",
        "",
        f"Observation ({agent.width},) float32, clipped to -{OBSERVATION_LIMIT:g}.."
        f"{OBSERVATION_LIMIT:g}. A block's value is the function given of its quantity x; noise "
        "may carry measured ones past their range.",
        "",
        "| index | observation | unit of x | value | range | meaning |",
        "|---|---|---|---|---|---|",
        *(
            f"| {b.index} | `{b.name}` | {b.unit} | {b.scale} | {b.range} | {b.meaning} |"
            for b in agent.observation
        ),
        "",
        f"Action ({agent.chambers},) float32:",
        "",
        "| index | action | unit | range | meaning |",
        "|---|---|---|---|---|",
        f"| 0-{last} | `change` | kPa | -{limit}..{limit} | changes of the commanded pressures |",
        "",
        "Reward, the sum of weight times term in every step:",
        "",
        "| reward term | weight | term |",
        "|---|---|---|",
        *(f"| `{term.name}` | {term.weight:g} | {term.meaning} |" for term in agent.rewards),
        "",
        agent.symbols,
        "",
    ]


def _table(settings: Iterable[Setting]) -> list[str]:
    rows = [f"| `{each.name}` | {each.value} | {each.meaning} |" for each in settings]
    return ["| config | default | meaning |", "|---|---|---|", *rows, ""]


def main(arguments: list[str]) -> int:
    """Write the pages to a folder, or with `--check` say which differ; returns the exit code."""
    check = "--check" in arguments
    given = [Path(argument) for argument in arguments if argument != "--check"]
    if len(given) != 1 or not given[0].is_dir():
        raise InputError(f"expected one folder of pages, such as `{COMMAND}`")
    if not check:
        write_pages(given[0])
        return 0
    differ = outdated(given[0])
    if differ:
        sys.stderr.write(f"{', '.join(differ)}: out of date; write them with: {COMMAND}\n")
    return int(bool(differ))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
