"""Builds the package; recipes and sample recordings of the source tree go into it, as irlos_pipe/shipped."""

from collections.abc import Iterator
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

SHIPPED = (
    "recipes/**/*.yaml",
    "recipes/**/*.py",
    "data_samples/README.md",
    "data_samples/calibration-sky/*",
    "data_samples/ramp/*/*",
    "data_samples/truth/*",
)


def shipped() -> Iterator[Path]:
    """Yield the files that go into the package, from the top of the source tree."""
    root = Path(__file__).resolve().parent
    for pattern in SHIPPED:
        yield from (path.relative_to(root) for path in sorted(root.glob(pattern)) if path.is_file())


class BuildWithShipped(build_py):
    """Copies the files, unless the package is used where it lies: it finds them there."""

    def run(self) -> None:
        """See `setuptools.Command.run`."""
        super().run()
        if not self.editable_mode:
            for path in shipped():
                target = Path(self.build_lib, "irlos_pipe", "shipped", path)
                self.mkpath(str(target.parent))
                self.copy_file(str(path), str(target))


setup(cmdclass={"build_py": BuildWithShipped})
