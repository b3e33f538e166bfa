"""In what two runs differ, for messages: options by the flags that set them, images, pairs."""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Any

from sgam_sfm.options import NOT_IN_RESULTS, SHA256, VERSION

_CONTENT = "content of "

Told = tuple[Mapping[str, Any], Mapping[str, Any]]
"""The contents of a run's options.json and inputs.json."""


def difference(there: Told, here: Told) -> str:
    """What differs of all that results follow from: options, images, pairs, or cameras where nothing else does."""
    flags_there, flags_here = _flags(there[0]), _flags(here[0])
    changed = [
        flag if flag.startswith(_CONTENT) else f"{flag} ({flags_there.get(flag)} there, {value} here)"
        for flag, value in flags_here.items()
        if flags_there.get(flag) != value
    ]
    return ", ".join([*changed, *_images(there[1], here[1]), *_pairs(there[1], here[1])]) or "cameras"


def goes_on(there: Told, here: Told) -> bool:
    """Whether the same is matched here, and more pairs; of masks and label maps more may be there, too."""
    flags_there, flags_here = (
        {flag: value for flag, value in _flags(options).items() if not flag.startswith(_CONTENT)}
        for options, _ in (there, here)
    )
    images_there, images_here = (inputs.get("images", {}).items() for _, inputs in (there, here))
    pairs_there, pairs_here = (set(map(tuple, inputs.get("pairs", ()))) for _, inputs in (there, here))
    return flags_there == flags_here and images_there <= images_here and pairs_there < pairs_here


def _images(there: Mapping[str, Any], here: Mapping[str, Any]) -> list[str]:
    before, now = (inputs.get("images", {}) for inputs in (there, here))
    changed = {name for name in before.keys() & now.keys() if before[name] != now[name]}
    return _counted("images", before.keys() - now.keys(), now.keys() - before.keys(), changed)


def _pairs(there: Mapping[str, Any], here: Mapping[str, Any]) -> list[str]:
    before, now = ({" ".join(pair) for pair in inputs.get("pairs", ())} for inputs in (there, here))
    return _counted("pairs", before - now, now - before)


def _counted(what: str, gone: Set[str], added: Set[str], changed: Set[str] = frozenset()) -> list[str]:
    """How many are not the same, each kind with an example; nothing when all are."""
    kinds = {"only there": gone, "only here": added, "with another content": changed}
    told = [f"{len(names)} {kind}, '{min(names)}' for one" for kind, names in kinds.items() if names]
    return [f"{what} ({'; '.join(told)})"] if told else []


def _flags(options: Mapping[str, Any], prefix: str = "--") -> dict[str, Any]:
    """Nested options by the flags that set them, those left out that results do not follow from."""
    flat: dict[str, Any] = {}
    for name, value in options.items():
        if prefix == "--" and name in NOT_IN_RESULTS | {"fingerprint"}:
            continue
        flag = "version of sgam-sfm" if name == VERSION else prefix + name.removesuffix(SHA256).replace("_", "-")
        flag = _CONTENT + flag if name.endswith(SHA256) else flag
        flat |= _flags(value, "--" if name == "crop" else f"{flag}.") if isinstance(value, dict) else {flag: value}
    return flat
