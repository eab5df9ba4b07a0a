"""Read a YAML file strictly, remembering on which line every value stands.

Recipes, side-cars and instrument profiles are written by hand; what YAML forgives (a key given twice) is
where mistakes hide, so it is not forgiven here. Booleans and numbers are those of YAML 1.2: ``off`` is a
word, ``010`` ten, ``1:30`` text and ``1e-3`` a number, where PyYAML follows version 1.1.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError
from irlos_pipe.files.regular import open_regular

MAX_BYTES = 1_000_000  # of a file: some seconds of parsing; one defocus per frame of 100 000 frames
MAX_DEPTH = 30  # of lists and sections in each other


if TYPE_CHECKING:
    from yaml import SafeLoader as FastestLoader
else:
    FastestLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml's parser, seven times as fast


BOOL, INT, FLOAT = (f"tag:yaml.org,2002:{kind}" for kind in ("bool", "int", "float"))
# The core schema of YAML 1.2, section 10.3.2: https://yaml.org/spec/1.2.2/#103-core-schema
SCALARS = {
    BOOL: (r"true|True|TRUE|false|False|FALSE", "tTfF"),
    INT: (r"[-+]?[0-9]+|0x[0-9a-fA-F]+", "-+0123456789"),
    FLOAT: (
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
}


def _resolvers() -> dict:
    """Those of PyYAML, but of booleans and numbers those of YAML 1.2."""
    kept = {
        first: [entry for entry in entries if entry[0] not in SCALARS]
        for first, entries in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    for tag, (pattern, firsts) in SCALARS.items():  # the integer before the float, which fits it as well
        for first in firsts:
            kept.setdefault(first, []).append((tag, re.compile(f"^(?:{pattern})$")))
    return kept


def _integer(loader: Any, node: yaml.ScalarNode) -> int:
    text = node.value.lower()
    return int(text, 16) if text.startswith("0x") else int(text)


class _Loader(FastestLoader):
    """Safe loader with the booleans and numbers of YAML 1.2."""

    yaml_implicit_resolvers = _resolvers()


_Loader.add_constructor(INT, _integer)


class _Dumper(yaml.SafeDumper):
    """Safe dumper that writes out what occurs twice, as `load_yaml` refuses aliases."""

    yaml_implicit_resolvers = _resolvers()

    def ignore_aliases(self, data: Any) -> bool:
        return True


class _Refused(Exception):
    """A construct this project does not accept, with the line where it stands."""

    def __init__(self, line: int, problem: str):
        super().__init__(problem)
        self.line = line


def load_yaml(
    path: str | Path, error: type[IrlosError] = ConfigurationError
) -> tuple[dict, dict[tuple, int]]:
    """Return the plain values of the YAML file at `path`, a mapping in UTF-8, and the lines they stand on.

    Lines count from 1, by key path, for example ``("diversity", "zernike", 6)``; list items count from 0, and
    the empty tuple is the top of the file. An `error` with one line ``file:line: problem`` is raised for an
    unreadable file, bad syntax, duplicate key, alias, tag, or a top level that is no mapping.
    """
    path = Path(path)
    return parse_yaml(_read_text(path, error), str(path), error)


def parse_yaml(text: str, name: str, error: type[IrlosError] = ConfigurationError) -> tuple[dict, dict]:
    """Parse `text` like `load_yaml`; messages of the `error` name the file `name`."""
    try:
        _refuse_aliases_and_tags(text)
        node = yaml.compose(text, Loader=_Loader)
        lines: dict[tuple, int] = {(): 1}
        data = _build(node, (), lines, _Loader(""))
    except _Refused as exc:
        raise error(f"{name}:{exc.line}: {exc}") from None
    except (yaml.YAMLError, ValueError, OverflowError) as exc:
        mark = getattr(exc, "problem_mark", None) or getattr(exc, "context_mark", None)
        problem = " ".join(str(getattr(exc, "problem", None) or exc).split())
        raise error(f"{name}:{mark.line + 1 if mark else 1}: not valid YAML: {problem}") from None
    if not isinstance(data, dict):
        raise error(
            f"{name}:1: expected 'key: value' pairs, found {'nothing' if data is None else 'something else'}"
        )
    return data, lines


def yaml_text(data: dict) -> str:
    """Return plain values as YAML that `load_yaml` reads; the keys keep their order."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)


def line_of(lines: dict[tuple, int], key_path: tuple) -> int:
    """Return the line, out of `lines`, of the longest part of `key_path` that stands in the file."""
    for length in range(len(key_path), 0, -1):
        if tuple(key_path[:length]) in lines:
            return lines[tuple(key_path[:length])]
    return lines.get((), 1)


def _read_text(path: Path, error: type[IrlosError]) -> str:
    try:
        with open_regular(path) as stream:
            content = stream.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise error(f"{path}: larger than {MAX_BYTES // 1_000_000} MB; this is not a settings file")
        return content.decode("utf-8-sig")
    except OSError as exc:
        raise error(f"{path}: cannot be read: {exc.strerror or exc}") from None
    except UnicodeDecodeError:
        raise error(f"{path}: not a UTF-8 text file") from None


def _refuse_aliases_and_tags(text: str) -> None:
    """Stop before anything is built: aliases can expand without bound, tags can ask for objects."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        line = event.start_mark.line + 1 if event.start_mark else 1
        if isinstance(event, yaml.AliasEvent):
            raise _Refused(line, f"alias '*{event.anchor}' is not accepted; write the value out")
        tag = getattr(event, "tag", None)
        if tag:
            raise _Refused(line, f"tag '{tag}' is not accepted; write a plain value")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise _Refused(line, f"nested more than {MAX_DEPTH} deep")


def _build(node: yaml.Node | None, key_path: tuple, lines: dict[tuple, int], loader: _Loader) -> Any:
    if isinstance(node, yaml.MappingNode):
        data, written = {}, dict[str, int]()
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode):
                raise _Refused(line, "a key must be a plain word or number")
            key = _scalar(key_node, loader)
            # 6, 6.0 and '6' are one mode
            same = str(int(key)) if isinstance(key, float) and key.is_integer() else str(key)
            if same in written:
                raise _Refused(line, f"key '{key}' is given twice (first on line {written[same]})")
            lines[(*key_path, key)] = written[same] = line
            data[key] = _build(value_node, (*key_path, key), lines, loader)
        return data
    if isinstance(node, yaml.SequenceNode):
        items = []
        for index, child in enumerate(node.value):
            lines[(*key_path, index)] = child.start_mark.line + 1
            items.append(_build(child, (*key_path, index), lines, loader))
        return items
    return _scalar(node, loader) if isinstance(node, yaml.ScalarNode) else None


def _scalar(node: yaml.ScalarNode, loader: _Loader) -> Any:
    value = loader.construct_object(node)
    if isinstance(value, str) and any("\ud800" <= letter <= "\udfff" for letter in value):
        raise _Refused(node.start_mark.line + 1, "half of a surrogate pair is no letter; write the letter")
    return value
