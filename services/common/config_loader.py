"""Fill the configuration tree: defaults < /etc/treedock/*.toml < --config < TREEDOCK_* variables < flags.

Each value remembers where it came from, so that a fault names the file, variable or flag to mend.
"""

from __future__ import annotations

import difflib
import json
import os
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from services.common.config import TreedockConfig
from services.common.config_versions import current
from services.common.errors import InputError
from services.common.unit_slips import slip

SYSTEM_DIRECTORY = Path("/etc/treedock")
_PREFIX = "TREEDOCK_"
_NOT_SETTINGS = frozenset({"TREEDOCK_DATA", "TREEDOCK_CONFIG"})
"""Variables of tests and of the deployment; TREEDOCK_CONFIG stands for --config."""


@dataclass(frozen=True, slots=True)
class LoadedConfig:
    """The tree and, for each dotted key that was set, who set it last."""

    config: TreedockConfig
    origins: dict[str, str]


@dataclass(frozen=True, slots=True)
class _Setting:
    key: str
    value: object
    origin: str


def load(
    file: Path | None = None,
    flags: Iterable[str] = (),
    overrides: Mapping[str, object] | None = None,
    environ: Mapping[str, str] | None = None,
    system_directory: Path = SYSTEM_DIRECTORY,
) -> LoadedConfig:
    """Return the configuration.

    Args:
        file: of ``--config``: TOML, or JSON when it ends in .json.
        flags: of ``--set``: ``section.key=value``, the value written as in TOML, quotes of text may be left out.
        overrides: dotted keys that other flags stand for; they win over everything.
        environ: the variables; the process's own when None.
        system_directory: where the machine's settings lie.

    Raises:
        InputError: a missing or broken file, an unknown key (with the nearest known one), an impossible value.
    """
    environ = os.environ if environ is None else environ
    if file is None and environ.get("TREEDOCK_CONFIG"):
        file = Path(environ["TREEDOCK_CONFIG"])
    settings: list[_Setting] = []
    for path in _system_files(system_directory):
        settings += _from_file(path)
    if file is not None:
        settings += _from_file(file)
    settings += _from_environment(environ)
    settings += [_from_flag(flag) for flag in flags]
    settings += [_Setting(key, value, "a flag") for key, value in (overrides or {}).items()]
    return _assemble(settings)


def _system_files(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.suffix == ".toml")
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:  # glob would find nothing and say nothing: the defaults would be in force
        raise InputError(f"{folder}: this user may not look into it: sudo chmod a+rx {folder}") from error


def _from_file(path: Path) -> list[_Setting]:
    try:
        text = path.read_text()
        body = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except PermissionError as error:
        raise InputError(f"{path}: this user may not read it: sudo chmod a+r {path}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give --config an existing file") from error
    except ValueError as error:  # both parsers' errors are of this kind, as is text that is not UTF-8
        raise InputError(f"{path}: not valid {'JSON' if path.suffix == '.json' else 'TOML'}: {error}") from error
    if not isinstance(body, dict):
        raise InputError(f"{path}: expected sections with keys, found {type(body).__name__}")
    return list(_flatten(current(body, str(path)), TreedockConfig, "", str(path)))


def _flatten(body: Mapping[str, object], model: type[BaseModel] | None, prefix: str, origin: str) -> Iterable[_Setting]:
    """Yield the settings of a nested mapping, section by section as the tree knows them."""
    for name, value in body.items():
        key = f"{prefix}{name}"
        section = _section(model, name) if model else None
        unknown = model is None or name not in model.model_fields
        # a section of which every line is a comment says nothing; one that is unknown is refused also when it is empty
        if isinstance(value, Mapping) and (section is not None or (unknown and value)):
            yield from _flatten(value, section, f"{key}.", origin)
        else:
            yield _Setting(key, value, origin)


def _section(model: type[BaseModel], name: str) -> type[BaseModel] | None:
    known = model.model_fields.get(name)
    kind = known.annotation if known else None
    return kind if isinstance(kind, type) and issubclass(kind, BaseModel) else None


def _from_environment(environ: Mapping[str, str]) -> list[_Setting]:
    found = []
    for name in sorted(environ):
        if name.startswith(_PREFIX) and name not in _NOT_SETTINGS:
            key = name.removeprefix(_PREFIX).lower().replace("__", ".")
            found.append(_Setting(_proper_case(key), _value(environ[name]), name))
    return found


def _proper_case(key: str) -> str:
    """Return the known key that differs in capitals only: variables are written in capitals throughout."""
    return {known.lower(): known for known in known_keys()}.get(key, key)


def _from_flag(flag: str) -> _Setting:
    key, equals, value = flag.partition("=")
    if not equals or not key.strip():
        raise InputError(f"--set {flag!r}: expected section.key=value, for example --set slam.features=800")
    return _Setting(key.strip(), _value(value.strip()), f"--set {key.strip()}")


def _value(text: str) -> object:
    """Return ``text`` read as a TOML value, or as it stands."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def known_keys(model: type[BaseModel] = TreedockConfig, prefix: str = "") -> list[str]:
    """Return every dotted key of the tree."""
    keys: list[str] = []
    for name in model.model_fields:
        section = _section(model, name)
        keys += known_keys(section, f"{prefix}{name}.") if section else [f"{prefix}{name}"]
    return keys


def _assemble(settings: list[_Setting]) -> LoadedConfig:
    known = known_keys()
    values: dict[str, _Setting] = {}
    for setting in settings:
        if setting.key not in known:
            raise InputError(f"{setting.origin}: {_unknown(setting.key, known)}")
        values[setting.key] = setting
    tree: dict[str, Any] = {}
    for key, setting in values.items():
        *sections, leaf = key.split(".")
        branch = tree
        for section in sections:
            branch = branch.setdefault(section, {})
        branch[leaf] = setting.value
    try:
        config = TreedockConfig.model_validate(tree)
    except ValidationError as error:
        raise InputError(_fault(error, values)) from None
    defaults = TreedockConfig()
    for key, setting in values.items():
        if word := slip(defaults, config, key):
            raise InputError(f"{setting.origin}: {key} = {setting.value!r}: {word}")
    return LoadedConfig(config, {key: setting.origin for key, setting in values.items()})


def _unknown(key: str, known: list[str]) -> str:
    inside = [k for k in known if k.startswith(f"{key}.")]
    if inside:
        return f"{key} is a section, not a value; its keys are {', '.join(k.rsplit('.', 1)[-1] for k in inside)}"
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
    return f"unknown key {key!r}; the nearest is {near[0]!r} (`treedock config` lists them all)"


def _fault(error: ValidationError, values: Mapping[str, _Setting]) -> str:
    first = error.errors(include_url=False)[0]
    said = first["msg"].removeprefix("Value error, ")  # pydantic's own word for what our rules say
    key = ".".join(str(part) for part in first["loc"])
    while key and key not in values:  # a whole section's rule, or an element of a list, names no key of its own
        inside = next((k for k in values if k.startswith(f"{key}.")), None)
        if inside:
            return f"{values[inside].origin}: {key}: {said}"
        key = key.rpartition(".")[0]
    if key:
        return f"{values[key].origin}: {key} = {values[key].value!r}: {said}"
    # a rule over several sections: whoever set what it speaks of
    origins = dict.fromkeys(setting.origin for k, setting in values.items() if k in said)
    return f"{', '.join(origins) or 'configuration'}: {said}"


def to_toml(tree: Mapping[str, object], origins: Mapping[str, str], prefix: str = "") -> str:
    """Return ``tree`` (from ``model_dump(mode="json")``) as TOML; values that somebody set carry the origin."""
    lines: list[str] = []
    sections: list[str] = []
    for name, value in tree.items():
        key = f"{prefix}{name}"
        if isinstance(value, Mapping):
            sections.append(f"\n[{key}]\n" + to_toml(value, origins, f"{key}."))
            continue
        mark = f"  # from {origins[key]}" if key in origins else ""
        # TOML knows no null
        lines.append(f"# {name} is not set" if value is None else f"{name} = {_toml_value(value)}{mark}")
    return "\n".join(lines) + "\n" * bool(lines) + "".join(sections)


def _toml_value(value: object) -> str:
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k} = {_toml_value(v)}" for k, v in value.items() if v is not None) + "}"
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return f"{value:.1f}"
    return json.dumps(value, ensure_ascii=False)
