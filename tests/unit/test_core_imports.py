import subprocess
import sys


def test_the_core_imports_neither_torch_nor_pycolmap_nor_the_application():
    code = "import sgam_core, sys; print(sorted({m.partition('.')[0] for m in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "'sgam_core'" in loaded
    for package in ("torch", "kornia", "pycolmap", "onnxruntime", "h5py", "sgam_sfm"):
        assert f"'{package}'" not in loaded
