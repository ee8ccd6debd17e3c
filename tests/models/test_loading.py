"""`DepthModel`: what `predict` writes is what transformers' pipeline gives, whatever the backbone; pictures; kinds."""

import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.backbones import picture, tiny_metric3d, tiny_vggt
from helpers.tiny import SIZE, tiny_model, tiny_processor
from PIL import Image
from safetensors.torch import load_file
from transformers import pipeline

from gift_peft import DepthModel
from gift_peft.adapters.folder import save_adapter
from gift_peft.adapters.recipes import get_gift_model
from gift_peft.models.loading import load_base
from gift_peft.models.metric3d.image_processing_metric3d import Metric3DImageProcessorPil
from gift_peft.models.vggt.image_processing_vggt import VggtImageProcessorPil
from gift_peft.predict import predict_images

BACKBONES = {
    "depth_anything": (tiny_model, tiny_processor),
    "vggt": (tiny_vggt, VggtImageProcessorPil),
    "metric3d": (tiny_metric3d, Metric3DImageProcessorPil),
}


@pytest.fixture(scope="module", params=BACKBONES)
def adapted(request, tmp_path_factory):
    """(folder of a tiny base, folder of a random adapter for it) of each backbone."""
    make, make_processor = BACKBONES[request.param]
    base, adapter = (tmp_path_factory.mktemp(request.param) / name for name in ("base", "adapter"))
    make().save_pretrained(base)
    make_processor().save_pretrained(base)
    torch.manual_seed(0)
    model = get_gift_model(make(), rank=2)
    with torch.no_grad():
        for weight in model.parameters():
            if weight.requires_grad:
                weight += 0.002 * torch.randn_like(weight)
    with pytest.warns(UserWarning, match="local"):
        save_adapter(model, adapter, str(base), processor=make_processor(), size=SIZE)
    return base, adapter


def test_predict_writes_what_the_pipeline_gives(adapted, tmp_path):
    base, adapter = adapted
    picture(45, 61).save(tmp_path / "photo.png")
    (path,) = predict_images([tmp_path / "photo.png"], base, adapter, out=tmp_path / "out", progress=False)
    # Of an adapter's folder the pipeline would take the base's image processor, whose size may be another.
    estimate = pipeline("depth-estimation", model=str(adapter), image_processor=str(adapter))
    expected = estimate(str(tmp_path / "photo.png"))["predicted_depth"]
    found = np.load(path)
    assert found.dtype == np.float32 and found.shape == (45, 61)
    np.testing.assert_array_equal(found, expected.numpy())
    model = DepthModel.from_pretrained(base, adapter)
    np.testing.assert_array_equal(model.depth_at(picture(45, 61)), found)
    np.testing.assert_array_equal(model.depth_at(np.asarray(picture(45, 61))), found)
    base_depth = model.depth_at(tmp_path / "photo.png", base=True)
    np.testing.assert_array_equal(base_depth, np.load(path.with_name("photo_base.npy")))
    assert not np.array_equal(base_depth, found)


def test_a_focal_length_makes_metres_of_the_camera_for_metric3d_alone(adapted):
    model = DepthModel.from_pretrained(*adapted)
    if model.network.config.model_type != "gift_metric3d":
        with pytest.raises(ValueError, match=r"focal_length: \w+ImageProcessor\w* takes none"):
            model.depth_at(picture(45, 61), focal_length=500)
        return
    depth, doubled = model.depth_at(picture(45, 61)), model.depth_at(picture(45, 61), focal_length=(500, 600))
    factor = (500 * SIZE[1] / 61 + 600 * SIZE[0] / 45) / 2 / 1000
    np.testing.assert_allclose(doubled, factor * depth, rtol=1e-6)


def test_padding_of_the_processor_is_no_part_of_a_prediction():
    """Pictures are stretched to the size, so nothing may be cut off as if they had been padded."""
    kept = VggtImageProcessorPil(size={"height": 70, "width": 70}, keep_aspect_ratio=True, do_pad=True)
    plain = VggtImageProcessorPil(size={"height": SIZE[0], "width": SIZE[1]})
    found, expected = (DepthModel(tiny_vggt(), processor, SIZE).depth_at(picture()) for processor in (kept, plain))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("shape", [(1, 40), (40, 1), (1, 1)])
def test_a_side_of_one_pixel_stays(shape):
    processor = VggtImageProcessorPil(size={"height": SIZE[0], "width": SIZE[1]})
    assert DepthModel(tiny_vggt(), processor, SIZE).depth_at(np.zeros((*shape, 3), np.uint8)).shape == shape


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 5, 1), np.uint8),
        np.zeros((3, 4, 5), np.uint8),
        np.zeros((4, 5, 3)),
        np.zeros((0, 0, 3), np.uint8),
        np.zeros(5, np.uint8),
        None,
        torch.zeros(3),
    ],
)
def test_what_is_no_picture_is_said_so(image):
    processor = VggtImageProcessorPil(size={"height": SIZE[0], "width": SIZE[1]})
    with pytest.raises(ValueError, match=r"the picture: .* is expected, not"):
        DepthModel(tiny_vggt(), processor, SIZE).depth_at(image)


@pytest.mark.parametrize("model_type", ["zoedepth", "depth_pro"])
def test_native_units_stay_where_the_post_processing_would_change_them(model_type):
    class Network(torch.nn.Module):
        config = SimpleNamespace(model_type=model_type)

        def forward(self, pixel_values):
            return SimpleNamespace(predicted_depth=pixel_values.mean(1) + 2)

    class Processor(VggtImageProcessorPil):
        def post_process_depth_estimation(self, *args, **kwargs):
            raise NameError("name 'tvF' is not defined")

    processor = Processor(size={"height": SIZE[0], "width": SIZE[1]})
    model = DepthModel(Network(), processor, SIZE, kind="depth")
    depth = model.depth_at(picture(45, 61))
    native = model.predict(model.inputs([picture(45, 61)]))
    expected = torch.nn.functional.interpolate(native[None], (45, 61), mode="bicubic")[0, 0]
    np.testing.assert_array_equal(depth, expected.numpy())


def test_what_is_known_of_a_model():
    assert DepthModel(tiny_model()).kind == "inverse_depth"
    metric = DepthModel(tiny_model(depth_estimation_type="metric", max_depth=10))
    assert (metric.kind, metric.millimeters_per_unit) == ("depth", 1000)
    plain = DepthModel(lambda x: x[:, 0], tiny_processor(), SIZE)
    assert (plain.kind, plain.millimeters_per_unit, plain.adapted, plain.size) == (None, 1, False, SIZE)
    with pytest.raises(ValueError, match='say what the model predicts: kind="depth"'):
        plain.known_kind()
    with pytest.raises(ValueError, match="unknown kind 'disparity': choose one of depth, inverse_depth"):
        DepthModel(plain.network, kind="disparity")
    with pytest.raises(ValueError, match="does not say where it came from; pass its processor="):
        DepthModel(plain.network).inputs([picture()])
    with pytest.raises(ValueError, match="a DepthModel brings its own size: give it where the model is made"):
        DepthModel.of(plain, size=SIZE, kind=None)


def test_pictures_come_upright_in_8_bit_and_predictions_finite():
    model = DepthModel(lambda x: x[:, 0], tiny_processor(), SIZE)
    turned = picture(45, 61)
    turned.getexif()[Image.ExifTags.Base.Orientation] = 6
    assert model.depth_at(turned).shape == (61, 45)
    assert model.depth_at(np.zeros((45, 61), np.uint8)).shape == (45, 61)
    with pytest.raises(ValueError, match=r"the picture: \(H,W,3\) uint8 is expected, not \(45, 61, 3\) float64"):
        model.depth_at(np.zeros((45, 61, 3)))
    with pytest.raises(ValueError, match="the picture: the prediction has NaN or infinite values"):
        DepthModel(lambda x: x[:, 0] / 0, tiny_processor(), SIZE).depth_at(picture())


def test_the_teacher_is_the_base_of_a_network_without_an_adapter():
    model = DepthModel(tiny_model(1), teacher=DepthModel(tiny_model()))
    pixels = torch.randn(3, 3, *SIZE, generator=torch.Generator().manual_seed(0))
    assert model.adapted and torch.equal(model.predict_base(pixels), DepthModel(tiny_model()).predict(pixels))
    assert torch.equal(model.predict(pixels), DepthModel(tiny_model(1)).predict_base(pixels))


def test_weights_come_from_safetensors_only(base_dir, tmp_path):
    folder = shutil.copytree(base_dir, tmp_path / "base")
    torch.save(load_file(folder / "model.safetensors"), folder / "pytorch_model.bin")
    (folder / "model.safetensors").unlink()
    with pytest.raises(ValueError, match=r"pickled weights only \(\.bin\); take safetensors") as error:
        load_base(folder)
    assert "\n" not in str(error.value)


def test_predictions_are_made_without_tf32():
    """As far as one can see without a GPU: what cuDNN and cuBLAS are told during a forward, and after it."""
    parts = (torch.backends.cudnn.conv, torch.backends.cuda.matmul)
    before, seen = [part.fp32_precision for part in parts], []
    assert before[0] == "tf32"  # PyTorch's default

    def network(pixel_values):
        seen.extend(part.fp32_precision for part in parts)
        return pixel_values[:, 0]

    DepthModel(network, size=(4, 6)).predict(torch.zeros(1, 3, 4, 6))
    assert seen == ["ieee", "ieee"] and [part.fp32_precision for part in parts] == before
    assert torch.backends.cudnn.allow_tf32  # asked in the old way it still answers
