"""What a run uses of the machine."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from sgam_core.errors import OptionError
from sgam_sfm.machine import multiplies_bfloat16, runs_half, single_threads, use_threads


def test_all_threads_are_used_again_after_a_run_with_one():
    use_threads(0)
    before = torch.get_num_threads()
    use_threads(1)
    assert torch.get_num_threads() == 1
    use_threads(0)
    assert torch.get_num_threads() == before


def test_every_thread_of_ours_has_one_thread_of_torch():
    before = torch.get_num_threads()
    with single_threads() as threads, ThreadPoolExecutor(1) as pool:
        assert threads == before
        assert pool.submit(torch.get_num_threads).result() == 1
    assert torch.get_num_threads() == before


@pytest.mark.parametrize(
    ("precision", "device", "expected"),
    [
        ("auto", "cpu", False),
        ("auto", "cuda", True),
        ("full", "cpu", False),
        ("full", "cuda", False),
        ("half", "cuda", True),
    ],
)
def test_half_precision_is_for_cuda(precision, device, expected):
    assert runs_half(precision, torch.device(device)) is expected


def test_half_precision_on_the_cpu_is_refused():
    with pytest.raises(OptionError, match=r"^--precision half: on the CPU networks take .* leave it out, or give "):
        runs_half("half", torch.device("cpu"))


@pytest.mark.parametrize(
    ("capabilities", "device", "expected"),
    [
        ({"avx512_bf16": True}, "cpu", True),
        ({"avx512_bf16": False, "amx_bf16": True}, "cpu", True),
        ({"avx512_bf16": False, "avx2": True}, "cpu", False),
        ({"avx512_bf16": True}, "cuda", False),
    ],
)
def test_bfloat16_is_for_cpus_that_have_instructions_for_it(monkeypatch, capabilities, device, expected):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    assert multiplies_bfloat16(torch.device(device)) is expected


def test_less_than_no_thread_is_refused():
    with pytest.raises(OptionError, match=r"^--threads is -1; expected a number of cores, or 0 for all$"):
        use_threads(-1)
