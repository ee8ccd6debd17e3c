"""The light of two frames is compared by what shows the same in both, however much does not."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gift_peft.prepare.stillness import light_gain


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.5, 2.0), st.floats(0, 0.7))
def test_a_gain_is_found_beside_a_large_target_that_shows_something_else(seed, gain, share):
    rng = np.random.default_rng(seed)
    goal = rng.uniform(20, 110, (54, 96, 3))
    cells = goal / gain + rng.normal(0, 0.3, goal.shape)
    cells[:, : round(share * 96)] = rng.uniform(20, 240, (54, round(share * 96), 3))
    assert abs(light_gain(cells, goal) / gain - 1) < 0.03


def test_a_frame_without_usable_cells_has_no_gain():
    assert light_gain(np.full((5, 5, 3), 250.0), np.full((5, 5, 3), 2.0)) == 1.0
