"""``python -m irlos_pipe`` is the command ``irlos``."""

from irlos_pipe.commands.main import cli

if __name__ == "__main__":
    cli(prog_name="irlos")
