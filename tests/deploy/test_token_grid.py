"""MoGe-2 in an exported graph: rows and columns of tokens as Python works them out, and right at every size."""

from fractions import Fraction

import pytest
import torch
from helpers.exports import limit, relative, write_adapter
from helpers.grids import Grids
from helpers.moge import tiny_moge, tiny_vit
from hypothesis import given, settings
from hypothesis import strategies as st

from gift_peft import DepthModel
from gift_peft.deploy.bundle import ALARM
from gift_peft.deploy.onnx_export import deploy_onnx
from gift_peft.deploy.openvino_export import deploy_openvino
from gift_peft.deploy.resampling import resampled_by_matrices
from gift_peft.deploy.runtime import Predictor
from gift_peft.deploy.token_grid import linspace, positions
from gift_peft.models.moge import MogeImageProcessorPil

__all__ = ["tiny_vit"]  # a fixture

pytestmark = [
    pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing. is deprecated:FutureWarning"),
    pytest.mark.filterwarnings("ignore:the base is the local folder"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]
# Pictures of any shape, and square ones: with 25 tokens those have the grid of the vision transformer's own table.
SIZES = [(28, 42), (97, 61), (70, 70), (42, 322), (33, 47), (14, 20), (200, 200), (240, 320)]
TOKENS = (16, 25, 1564, 3600)


def python_grid(tokens: int, height: int, width: int) -> tuple[int, int]:
    """As the package has it."""
    aspect = width / height
    return round((tokens / aspect) ** 0.5), round((tokens * aspect) ** 0.5)


@pytest.fixture(scope="module")
def grids():
    both = Grids()
    with both.pool:
        yield both


@settings(max_examples=60, deadline=None)
@given(tokens=st.sampled_from(TOKENS), height=st.integers(1, 2000), width=st.integers(1, 2000))
def test_the_grid_is_pythons(grids, tokens, height, width):
    expected = python_grid(tokens, height, width)
    if 0 not in expected:  # of such a picture MoGe itself can make nothing
        assert grids(tokens, [(height, width)]) == [[expected] * 2]


@pytest.mark.parametrize("tokens", TOKENS)
def test_roots_that_end_in_a_half_are_rounded_as_python_does(grids, tokens):
    expected, ups = {}, set()
    for k in range(1, 90):
        ratio = Fraction((2 * k + 1) ** 2, 4 * tokens)
        for times in (1, 2, 7):
            sides = ratio.numerator * times, ratio.denominator * times
            for height, width in (sides, sides[::-1]):
                grid = python_grid(tokens, height, width)
                if height * width < 2**22 and 0 not in grid:
                    expected[height, width] = [grid] * 2
                    ups.add(grid[height == sides[1]] > k)
    assert dict(zip(expected, grids(tokens, list(expected)), strict=True)) == expected
    assert ups == {False, True}


@settings(max_examples=60, deadline=None)
@given(steps=st.integers(1, 200), start=st.floats(-10, 10), end=st.floats(-10, 10))
def test_linspace_is_torchs(steps, start, end):
    ours = linspace(start, end, steps, dtype=torch.float32)
    assert ours.dtype == torch.float32
    torch.testing.assert_close(ours, torch.linspace(start, end, steps), rtol=1e-6, atol=1e-6)
    assert linspace(0, 1, 3).tolist() == [0, 0.5, 1]


@pytest.mark.parametrize("grid", [(5, 5), (4, 6), (6, 4), (5, 7), (1, 9), (11, 3)])
def test_positions_are_the_vision_transformers(grid, tiny_vit):
    vit = tiny_moge().network.encoder.backbone
    rows, columns = grid
    x = torch.rand(1, rows * columns + 1, vit.embed_dim)
    with torch.no_grad(), resampled_by_matrices():
        ours = positions(vit, x, 14 * rows, 14 * columns)
    torch.testing.assert_close(ours, vit.interpolate_pos_encoding(x, 14 * rows, 14 * columns), rtol=0, atol=1e-5)
    if grid == (5, 5):
        assert torch.equal(ours, vit.pos_embed)


def adapter_of(name, folder, **config):
    return write_adapter(folder, tiny_moge(name=name, **config), MogeImageProcessorPil(), (56, 84))


def assert_right(predictor, model, scale=None):
    for index, size in enumerate(SIZES):
        x = torch.rand(1 + index % 3, 3, *size, generator=torch.Generator().manual_seed(index))
        error = relative(predictor.predict(x.numpy(), scale), model.predict(x).numpy())
        # OpenVINO has no float64, in which the shift is searched for; noise has none that stands out.
        most = limit(model, x) if predictor.backend == "onnx" else ALARM
        assert error <= most, (predictor.backend, scale, size)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "config"), [("v2-normal", {}), ("v2", {"num_tokens": 25})])
def test_moge_is_right_at_every_size(name, config, tiny_vit, tmp_path):
    adapter = adapter_of(name, tmp_path, **config)
    out = deploy_onnx(adapter, tmp_path / "out")
    model = DepthModel.from_pretrained(tmp_path / "base", adapter, device="cpu")
    for backend in ("onnx", "openvino"):
        predictor = Predictor(out, backend)
        assert_right(predictor, model)
        assert predictor.settings["kind"] == "depth" and predictor.settings["unit"] == "depth in meters"


@pytest.mark.slow
def test_moge_with_a_dial(tiny_vit, tmp_path):
    adapter = adapter_of("v2-normal", tmp_path)
    predictor = Predictor(deploy_openvino(adapter, tmp_path / "out", dial=True))
    for scale in (-1.0, 0.0, 0.35, 1.0):
        assert_right(predictor, DepthModel.from_pretrained(tmp_path / "base", adapter, scale), scale)


@pytest.mark.slow
def test_the_first_version_is_refused_and_nothing_is_left(tiny_vit, tmp_path):
    adapter = adapter_of("v1", tmp_path)
    with pytest.raises(ValueError, match=r"the first version of MoGe is not exported: .*take --to transformers, or"):
        deploy_onnx(adapter, tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["adapter", "base"]
