"""Sets training settings by name from text, as in --set family.width=256."""

from __future__ import annotations

import difflib
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

from ..errors import SnergError
from ..nerf.model import HashModelConfig, MlpModelConfig
from .config import TrainSettings, one_of

FAMILIES: dict[str, type[HashModelConfig] | type[MlpModelConfig]] = {"hash": HashModelConfig, "mlp": MlpModelConfig}


def with_values(settings: TrainSettings, values: Mapping[str, str]) -> TrainSettings:
    """Settings with some of them changed by name, as text: {"rate": "1e-3", "family.width": "256", "clip_norm": "none"}.

    "family" itself is 'hash' or 'mlp' and gives that family's defaults. Raises SnergError on an unknown name or a value that
    does not fit it. A time to train for replaces a number of steps.
    """
    changed: dict[str, Any] = {"steps": None} if "seconds" in values and "steps" not in values else {}
    for name in sorted(values, key=lambda n: n.count(".")):  # the family before what it holds
        if name == "family":
            one_of(name, values[name], tuple(FAMILIES))
            changed[name] = FAMILIES[values[name]]()
        else:
            _put(changed, replace(settings, **({"family": changed["family"]} if "family" in changed else {})), name, values[name])
    return replace(settings, **changed)


def _put(changed: dict[str, Any], settings: TrainSettings, name: str, text: str) -> None:
    """Parse the value of `name`, which may lie within the family, into `changed`."""
    path = name.split(".")
    holders: list[Any] = [settings]
    for part in path[:-1]:
        holders.append(getattr(holders[-1], part, None))
        if not is_dataclass(holders[-1]):
            _unknown(name, settings)
    kinds = typing.get_type_hints(type(holders[-1]))
    if path[-1] not in kinds or path[-1] not in {f.name for f in fields(holders[-1])} or is_dataclass(getattr(holders[-1], path[-1])):
        _unknown(name, settings)
    value: Any = _parsed(name, text, kinds[path[-1]])
    for part, holder in zip(reversed(path[1:]), reversed(holders[1:]), strict=True):
        value = replace(holder, **{part: value})
    changed[path[0]] = value


def _unknown(name: str, settings: TrainSettings) -> typing.NoReturn:
    known = setting_names(settings)
    close = difflib.get_close_matches(name, known, 3, 0.5) or known
    raise SnergError(f"There is no setting {name!r}; did you mean {' or '.join(close)}?")


def setting_names(settings: TrainSettings) -> list[str]:
    """Every name that `with_values` takes for these settings: those of the family depend on which it is."""
    return ["family", *_names(settings, "")]


def _names(holder: Any, prefix: str) -> list[str]:
    names: list[str] = []
    for f in fields(holder):
        value = getattr(holder, f.name)
        names += _names(value, f"{prefix}{f.name}.") if is_dataclass(value) else [prefix + f.name]
    return names


def _parsed(name: str, text: str, kind: Any) -> Any:
    kinds: tuple[Any, ...] = typing.get_args(kind) or (kind,)  # int | None to (int, NoneType)
    low = text.strip().lower()
    if type(None) in kinds and low in ("none", ""):
        return None
    try:
        if bool in kinds:
            return {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}[low]
        if str in kinds:
            return text.strip()
        number = float(low)
        if int not in kinds:
            return number
        if number != int(number):
            raise ValueError
        return int(low) if low.lstrip("+-").isdigit() else int(number)
    except (ValueError, KeyError, OverflowError):
        wanted = "yes or no" if bool in kinds else "a whole number" if int in kinds else "a number"
        raise SnergError(f"The setting {name} is {text!r}; it must be {wanted}{' or none' if type(None) in kinds else ''}.") from None
