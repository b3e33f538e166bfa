import pytest

from sgam_core.wording import counted


@pytest.mark.parametrize(
    ("number", "noun", "text"),
    [
        (0, "pair", "0 pairs"),
        (1, "pair", "1 pair"),
        (2, "pair", "2 pairs"),
        (1, "area match", "1 area match"),
        (3, "area match", "3 area matches"),
        (2, "keypoint file", "2 keypoint files"),
        (2, "box", "2 boxes"),
    ],
)
def test_a_noun_follows_its_number(number, noun, text):
    assert counted(number, noun) == text
