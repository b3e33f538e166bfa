"""Models of the Hugging Face hub through transformers: a folder on this disk, the hub's cache, then the network."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sgam_core.errors import OptionError, WeightsError


def transformers_for(model: str) -> Any:
    """The package transformers, quiet: what goes wrong comes back as an error.

    Args: model: what needs it, as the user called it.
    Raises: OptionError when it is not installed.
    """
    try:
        import transformers
    except ModuleNotFoundError as error:
        raise OptionError(f"'{model}' needs the package '{error.name}'; run `pip install 'sgam-sfm[hf]'`") from error
    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()
    return transformers


def load(read: Callable[..., Any], name: str, model: str, **settings: Any) -> Any:
    """What one of transformers' readers, such as `AutoConfig.from_pretrained`, makes of a model.

    What is in the cache is taken from there without a look at the network.
    Args: name: a hub id, or a folder. model: what is loaded, as the user called it, for messages.
    Raises: WeightsError when it cannot be had or is damaged; OptionError when it needs a package that is not here.
    """
    folder = Path(name).expanduser()
    if not name:
        raise OptionError(
            f"'{model}' names no model; give its hub id or folder, such as {model.rstrip(':')}:OWNER/NAME"
        )
    if not folder.is_dir() and (folder.is_absolute() or name.startswith((".", "~")) or name.count("/") > 1):
        raise WeightsError(
            f"'{model}': the folder '{name}' does not exist; give one as `hf download` writes it, or a hub id"
        )
    try:
        if folder.is_dir():
            return read(str(folder), local_files_only=True, **settings)
        try:
            return read(name, local_files_only=True, **settings)
        except OSError:
            return read(name, **settings)
    except ImportError as error:
        raise OptionError(f"'{model}' needs a package that is not here ({_first_line(error)}); install it") from error
    except Exception as error:  # transformers raises a different type for every way in which a model can be wrong
        mend = (
            "expected a folder with config.json, preprocessor_config.json and model.safetensors; copy it again"
            if folder.is_dir()
            else f"check the hub id; without network run `hf download {name} --local-dir FOLDER` elsewhere and give "
            "the folder in place of the id"
        )
        raise WeightsError(f"'{model}' cannot be loaded ({_first_line(error)}); {mend}") from error


def load_network(network: Any, name: str, model: str, device: Any) -> Any:
    """A network with all of its weights, ready to run.

    Args: network: the class of transformers that it is. name, model: as of `load`.
    Raises: as `load`; WeightsError also when weights are missing, which transformers would draw at random.
    """
    net, report = load(network.from_pretrained, name, model, output_loading_info=True)
    missing = sorted(map(str, [*report["missing_keys"], *report["mismatched_keys"]]))
    if missing:
        raise WeightsError(
            f"'{model}' lacks {len(missing)} of its weights ({', '.join(missing[:3])}); give the model that its "
            "config.json describes"
        )
    return net.eval().requires_grad_(False).to(device)


def download(name: str, model: str) -> Path:
    """Put a model of the hub into its cache. Returns: the folder there.

    Raises: as `load`.
    """
    transformers_for(model)
    from huggingface_hub import snapshot_download

    def fetch(hub_id: str, local_files_only: bool = False) -> str:
        if local_files_only:
            raise OSError("the cache may have a part of it only")
        return str(snapshot_download(hub_id))

    return Path(load(fetch, name, model))


def in_cache(name: str) -> Path | None:
    """Where the hub's cache has a model, None when it does not or huggingface_hub is not installed."""
    try:
        from huggingface_hub import try_to_load_from_cache
    except ModuleNotFoundError:
        return None
    found = try_to_load_from_cache(name, "model.safetensors")
    return Path(found) if isinstance(found, str) else None


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0].strip().rstrip(".:")
