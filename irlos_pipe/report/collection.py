"""The report on several experiments: a chapter for each, in one file that needs nothing else."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from markupsafe import Markup

from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import flat
from irlos_pipe.product.results import Provenance, provenance_of
from irlos_pipe.report.build import stage_sections
from irlos_pipe.report.content import Block, Figure, Section, Stack, Table, Views, rendered, shown
from irlos_pipe.report.drawing import renamed
from irlos_pipe.report.run_data import read_run
from irlos_pipe.report.section_run import finished, meaning_section, warnings
from irlos_pipe.report.text import duration, is_known, number

TITLE = "The experiments of the paper"
LEFT_OUT = {"ingest"}  # frames as they came in: the experiment's own report shows them


@dataclass(frozen=True)
class Chapter:
    """What a report shows of one experiment."""

    name: str
    title: str
    status: str = "failed"  # as in results.json, ``failed`` where there are none
    problems: list[str] = field(default_factory=list)  # why it failed, and what it warned of
    sections: list[Section] = field(default_factory=list)
    settings: Table | None = None
    seed: int | None = None
    sizes: str = ""  # the whole numbers among the settings of its last stage: how much was drawn
    seconds: float | None = None  # wall time of all stages [s]
    finished: str = ""
    made: Provenance | None = None  # provenance of the last stage

    @property
    def time(self) -> str:
        return duration(self.seconds)


def read_chapter(name: str, folder: Path, problem: str = "") -> Chapter:
    """Read the run of an experiment, which a `problem` may have stopped; identifiers begin with its `name`.

    Raises `InputDataError` when it is not the folder of a run, or a product cannot be read.
    """
    run = read_run(folder)
    # Whole numbers among the settings of the last stage, without true and false.
    last = next(reversed(run.products.values()), None)
    sizes = [(key, value) for key, value in (last.config if last else {}).items() if type(value) is int]
    given = flat({stage: product.config for stage, product in run.products.items()})
    settings = [(".".join(path), _shown(value)) for path, value in given if value != {}]
    made = [provenance_of(product) for product in run.products.values()]
    return Chapter(
        name,
        run.recipe.get("title") or name,
        "failed" if problem else run.outcome.status,
        [*([problem] if problem else []), *warnings(run)],
        [_own(section, name) for stage, section in stage_sections(run).items() if stage not in LEFT_OUT],
        Table(("setting", "value"), settings, "Settings", folded=True),
        run.recipe.get("seed"),
        ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in sizes),
        sum(one.seconds for one in made if is_known(one.seconds)),
        finished(run),
        made[-1] if made else None,
    )


def _own(section: Section, name: str) -> Section:
    """The section with identifiers that no other chapter has."""
    blocks = [_own_block(block, name) for block in section.blocks]
    return replace(section, name=f"{name}-{section.name}", blocks=blocks)


def _own_block(block: Block, name: str) -> Block:
    if isinstance(block, Stack):
        return Stack([_own_block(inner, name) for inner in block.blocks])
    if isinstance(block, Views):
        choices = {
            one: [_own_block(inner, name) for inner in blocks] for one, blocks in block.choices.items()
        }
        return replace(block, name=f"{name}-{block.name}", choices=choices)
    own = f"{name}-{block.name}" if isinstance(block, Figure | Table) and block.name else ""
    if isinstance(block, Figure):
        return replace(block, svg=renamed(block.svg, name), name=own)
    return replace(block, name=own) if isinstance(block, Table) else block


def _shown(value: Any) -> str:
    return ", ".join(map(_shown, value)) if isinstance(value, list) else str(value)


# -- the page ----------------------------------------------------------------------------------


def write_collection(path: Path, note: str, chapters: Sequence[Chapter]) -> Path:
    """Write the page with a `note` below its title; the same chapters give the same file.

    Raises `IrlosError` when it cannot be written.
    """
    contents = Table.of(
        chapters,
        {
            "experiment": lambda one: Markup('<a href="#{}">{}</a>').format(one.name, one.title),
            "status": lambda one: one.status.replace("_", " "),
            "sizes": lambda one: one.sizes,
            "seed": lambda one: number(one.seed, "d"),
            "time": lambda one: one.time,
        },
        marks=["" if one.status == "ok" else "bad" for one in chapters],
    )
    all_sections = [section for chapter in chapters for section in chapter.sections]
    page = rendered(
        "collection.html.j2",
        title=TITLE,
        note=note,
        chapters=chapters,
        contents=contents,
        last=list(filter(None, [meaning_section([], all_sections), _origin(chapters)])),
    )
    write_bytes(path, page.encode())
    return path


def _origin(chapters: Sequence[Chapter]) -> Section:
    """Where and with what each experiment was run."""
    run = [(one, one.made) for one in chapters if one.made]
    table = Table.of(
        run,
        {
            "experiment": lambda one: one[0].name,
            "finished": lambda one: one[0].finished,
            "time": lambda one: one[0].time,
            "processes": lambda one: number(one[1].jobs, "d"),
            "machine": lambda one: f"{one[1].machine.host} ({one[1].machine.platform})",
        },
    )
    software = (", ".join(f"{name} {version}" for name, version in made.software.items()) for _, made in run)
    return Section("origin", "Machine and software", "; ".join(dict.fromkeys(software)), shown(table))
