"""The documentation site; `make docs` builds it with warnings as errors."""

import logging
import sys
from pathlib import Path

import click

import irlos_pipe
from irlos_pipe.commands.main import cli

HERE = Path(__file__).parent
sys.path.append(str(HERE.parent))
from maintenance.reference_pages import pages  # noqa: E402

project = "irlos_pipe"
author = "The irlos_pipe developers"
version = release = irlos_pipe.__version__
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "matplotlib.sphinxext.plot_directive",
]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # a test executes the tutorial; the site shows the outcome that is stored in it
exclude_patterns = ["_build", "images/*.py"]
html_theme = "furo"
html_title = f"irlos_pipe {version}"
html_static_path = ["static"]
html_css_files = ["site.css"]
copyright = f"{author} · version {version} · BSD 3-clause licence"  # the footer of every page
html_show_sphinx = False
plot_formats = [("png", 110)]
plot_working_directory = str(HERE / "_build")  # the run of the gallery stays there for the next build
plot_html_show_formats = plot_html_show_source_link = False
smartquotes = False  # options begin with two hyphens
autodoc_typehints = "none"  # the docstrings state types, shapes and units
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_rtype = False
logging.getLogger("irlos_pipe").propagate = False  # a package of furo prints what loggers pass on
# Files of the tree beside the site are linked as they lie, for readers on a code host.
suppress_warnings = ["myst.xref_missing"]


def commands_page() -> str:
    """Return the help of every command."""
    parts = ["# Commands\n\nEvery command shows this text with `--help`.\n"]
    for name, command in cli.commands.items():
        with click.Context(command, info_name=f"irlos {name}", max_content_width=88) as context:
            parts.append(f"## irlos {name}\n\n```text\n{command.get_help(context)}\n```\n")
    return "\n".join(parts)


def write_reference(_app: object) -> None:
    """Write the pages that are made from the package, and the folder that the gallery runs in."""
    Path(plot_working_directory).mkdir(exist_ok=True)
    folder = HERE / "reference"
    folder.mkdir(exist_ok=True)
    for name, text in (pages() | {"commands": commands_page()}).items():
        path = folder / f"{name}.md"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def setup(app: object) -> None:
    """Connect what has to be written before the site is read."""
    app.connect("builder-inited", write_reference)  # type: ignore[attr-defined]
