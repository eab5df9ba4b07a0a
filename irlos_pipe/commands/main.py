"""The command ``irlos`` with all its subcommands, which import what they need when they run."""

from itertools import chain

import click

import irlos_pipe
from irlos_pipe.commands.exits import EXIT_CODES, IrlosGroup, pdb_option
from irlos_pipe.commands.focus import focus
from irlos_pipe.commands.lookup import explain, recipes, sidecar
from irlos_pipe.commands.night import night, trend
from irlos_pipe.commands.products import compare, export, report, score, show, status
from irlos_pipe.commands.reduction import demo, reduce, run, validate
from irlos_pipe.commands.simulated import paper, simulate


@click.group(cls=IrlosGroup, epilog=EXIT_CODES, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(irlos_pipe.__version__, prog_name="irlos")
def cli() -> None:
    """Measure NCPAs and defocus on recordings of the IRLOS low-order sensor.

    \b
    Start here:
      irlos demo                  reduces the sample recordings into the folder demo
      irlos recipes
      irlos run full_reduction --input calibration=CUBE --input ramp=RAMP --output DIR
      irlos status demo
      irlos show demo/03_calibrate.h5

    irlos COMMAND --help explains each command.
    """


IrlosGroup.tasks = {
    "Reduce recordings": (reduce, run, validate, demo),
    "Describe recordings, look things up": (sidecar, recipes, explain),
    "Look at results": (status, show, report, compare, export, score),
    "Follow nights, close the loop": (night, trend, focus),
    "Simulate": (simulate, paper),
}
for command in chain.from_iterable(IrlosGroup.tasks.values()):
    command.params.append(pdb_option(hidden=True))
    cli.add_command(command)
cli.params.append(pdb_option(hidden=False))
