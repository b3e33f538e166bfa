"""What a run uses of the machine."""

import torch

from sgam_sfm.machine import use_threads


def test_all_threads_are_used_again_after_a_run_with_one():
    use_threads(0)
    before = torch.get_num_threads()
    use_threads(1)
    assert torch.get_num_threads() == 1
    use_threads(0)
    assert torch.get_num_threads() == before
