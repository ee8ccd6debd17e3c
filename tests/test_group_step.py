"""Snapshot and replay against autograd through the whole group, on one process, on two and on three."""

import math
from contextlib import contextmanager

import pytest
import torch
from accelerate import Accelerator, DistributedType, debug_launcher
from accelerate.state import AcceleratorState, GradientState
from peft import LoraConfig, get_peft_model
from tiny import tiny_model, tiny_processor, write_raw_tree
from torch import nn

from gift_peft.adapters import get_gift_model
from gift_peft.data.gift_i import load_gift_i
from gift_peft.evaluation.evaluate import evaluate_gift_i
from gift_peft.group_step import GroupStep
from gift_peft.losses import gift_loss
from gift_peft.training.teacher import make_proxies

SIZE = (28, 28)
COUNTS, CUTS = (2, 3, 5, 9), (1, 2, 4)
DTYPES = {"float64": torch.float64, "float32": torch.float32}
DEAD = "neck.fusion_stage.layers.0.residual_layer1"  # the first fusion has no residual: never a gradient


def gift_model(dtype=torch.float64, spread=0.02):
    """A tiny Depth Anything with a rank-2 adapter that is not at its start."""
    torch.manual_seed(0)
    model = get_gift_model(tiny_model(), rank=2).to(dtype)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.requires_grad:
                parameter += torch.randn(parameter.shape) * spread
    return model


def group(count, dtype=torch.float64, seed=0, size=SIZE):
    """Pixels, masks (some pairs disjoint, one image all target), proxies near the predictions, valid masks."""
    generator = torch.Generator().manual_seed(seed)
    pixels = torch.randn(count, 3, *size, generator=generator, dtype=torch.float64)
    mask = torch.rand(count, *size, generator=generator) < 0.5
    mask[0, :, : size[1] // 2] = False
    mask[-1, :, size[1] // 2 :] = False
    if count > 2:
        mask[1] = True
    target = torch.rand(count, *size, generator=generator, dtype=torch.float64) * 40
    valid = torch.rand(count, *size, generator=generator) < 0.9
    return pixels.to(dtype), mask, target.to(dtype), valid


def gradients(model):
    return {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}


def autograd_gradients(model, cut, pixels, mask, target, valid):
    """Through one graph over all images, in float64 in one batch, in float32 over the same micro-batches."""
    model.zero_grad(set_to_none=True)
    predictions = torch.cat([model(pixel_values=x).predicted_depth for x in pixels.split(cut)])
    loss = gift_loss(predictions, target, mask, 0.8, 1.5, valid)
    loss.total.backward()
    return loss, gradients(model)


def step_gradients(model, cut, retain, data, accelerator=None):
    model.zero_grad(set_to_none=True)
    step = GroupStep(model, 0.8, 1.5, cut, retain, accelerator)
    return step.accumulate(*data), gradients(model)


def largest_error(got, want):
    assert got.keys() == want.keys()
    return max((got[name] - want[name]).abs().max().item() for name in want)


def scale(values):
    return max(value.abs().max().item() for value in values.values())


def num_retained(count, cut, retain):
    """Images of the last whole micro-batches that fit, counted one by one."""
    sizes = [min(cut, count - start) for start in range(0, count, cut)]
    kept = 0
    while sizes and kept + sizes[-1] <= retain:
        kept += sizes.pop()
    return kept


# ---- one process ----


@pytest.fixture(scope="module", params=DTYPES)
def model_of(request):
    return gift_model(DTYPES[request.param])


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("count", COUNTS)
def test_gradient_is_that_of_the_whole_group(model_of, count, cut):
    dtype = next(model_of.parameters()).dtype
    data = group(count, dtype)
    loss, want = autograd_gradients(model_of, count if dtype == torch.float64 else cut, *data)
    runs = {retain: step_gradients(model_of, cut, retain, data) for retain in (0, 2, count)}
    for retain, (output, got) in runs.items():
        assert largest_error(got, want) < (1e-10 if dtype == torch.float64 else 1e-6 * scale(want))
        assert all(torch.equal(got[name], runs[0][1][name]) for name in want)
        assert output.forwards == 2 * count - num_retained(count, cut, retain)
        assert output.num_pairs == loss.num_pairs
        for value, expected in zip(output[:3], loss[:3], strict=True):
            assert not value.requires_grad
            torch.testing.assert_close(
                value, expected.detach(), rtol=1e-5 if dtype == torch.float32 else 1e-12, atol=0
            )
    assert not any(DEAD in name for name in want) and any("lora_A" in name for name in want)


def test_adds_to_existing_gradients():
    model = gift_model()
    data, more = group(3), group(2, seed=1)
    _, first = step_gradients(model, 2, 0, data)
    _, second = step_gradients(model, 2, 0, more)
    step = GroupStep(model, 0.8, 1.5)
    model.zero_grad()
    step.accumulate(*data)
    step.accumulate(*more)
    assert largest_error(gradients(model), {name: first[name] + second[name] for name in first}) == 0


def test_first_step_of_a_fresh_adapter_has_no_distillation():
    """Proxies cut as the step cuts have the step's bits."""
    model = get_gift_model(tiny_model())
    pixels, mask, _, _ = group(5, torch.float32)
    with torch.no_grad(), model.disable_adapter():
        target = torch.cat([model(pixel_values=x).predicted_depth for x in pixels.split(2)])
    output = GroupStep(model).accumulate(pixels, mask, target)
    assert output.distillation == 0 and output.total == output.consistency > 0


class Toy(nn.Module):
    """Predicts (B,H,W) directly; `.seen` lists the batches, with grad or not."""

    def __init__(self, dtype=torch.float32):
        super().__init__()
        self.conv = nn.Conv2d(3, 4, 3, padding=1, dtype=dtype)
        self.out = nn.Conv2d(4, 1, 1, dtype=dtype)
        self.unused = nn.Parameter(torch.zeros(3, dtype=dtype))
        self.seen = []

    def forward(self, pixel_values):
        self.seen.append((len(pixel_values), torch.is_grad_enabled()))
        return self.out(self.conv(pixel_values).tanh())[:, 0]


def toy(dtype=torch.float32):
    torch.manual_seed(0)
    return Toy(dtype)


def test_schedule():
    model, data = toy(), group(5, torch.float32)
    assert GroupStep(model, retain=0).accumulate(*data).forwards == 10
    assert model.seen == [(2, False), (2, False), (1, False), (2, True), (2, True), (1, True)]
    model.seen.clear()
    assert GroupStep(model, retain=3).accumulate(*data).forwards == 7
    assert model.seen == [(2, False), (2, True), (1, True), (2, True)]
    assert model.unused.grad is None


def test_larger_snapshot_micro_batches():
    """Fewer forwards of more images; the last ones are retained and cut as ever."""
    model, data = toy(torch.float64), group(9)
    GroupStep(model, retain=0).accumulate(*data)
    want = gradients(model)
    for together, retain, seen in (
        (4, 0, [(4, False), (4, False), (1, False), *[(2, True)] * 4, (1, True)]),
        (4, 3, [(4, False), (2, False), (2, True), (1, True), *[(2, True)] * 3]),
        (8, 9, [*[(2, True)] * 4, (1, True)]),
    ):
        model.zero_grad()
        model.seen.clear()
        step = GroupStep(model, retain=retain, snapshot_micro_batch_size=together)
        assert step.accumulate(*data).forwards == 18 - retain
        assert model.seen == seen
        assert largest_error(gradients(model), want) < 1e-12


def test_phases_of_a_step():
    names = []

    @contextmanager
    def phase(name):
        names.append(name)
        yield
        names.append("end")

    step = GroupStep(toy(), retain=0)
    step.phase = phase
    step.accumulate(*group(3, torch.float32))
    assert names == ["snapshot", "end", "loss", "end", "replay", "end"]


def test_works_under_no_grad_and_leaves_the_mode_alone():
    model, data = toy(), group(3, torch.float32)
    GroupStep(model).accumulate(*data)
    want = gradients(model)
    model.zero_grad()
    model.eval()
    with torch.no_grad():
        GroupStep(model).accumulate(*data)
    assert largest_error(gradients(model), want) == 0 and not model.training


def test_no_pair_and_no_other_region_give_zero_gradients():
    model, (pixels, mask, target, _) = toy(), group(3, torch.float32)
    output = GroupStep(model).accumulate(pixels, torch.zeros_like(mask), target, torch.zeros_like(mask))
    assert output.total == 0 and output.num_pairs == 0
    assert model.conv.weight.grad is not None and not model.conv.weight.grad.any()


def test_bf16_autocast():
    model, data = toy(), group(3, torch.float32)
    AcceleratorState._reset_state(reset_partial_state=True)
    step = GroupStep(model, accelerator=Accelerator(cpu=True, mixed_precision="bf16"))
    AcceleratorState._reset_state(reset_partial_state=True)
    assert step.mixed_precision == "bf16" and GroupStep(model).mixed_precision == "no"
    step.accumulate(*data)
    bf16 = gradients(model)
    with torch.autocast("cpu", torch.bfloat16):
        predictions = torch.cat([model(pixel_values=x) for x in data[0].split(2)])
        assert predictions.dtype == torch.bfloat16
    model.zero_grad()
    gift_loss(predictions, data[2], data[1], valid=data[3]).total.backward()
    assert largest_error(bf16, gradients(model)) < 1e-2 * scale(bf16)
    assert all(g.dtype == torch.float32 for g in bf16.values())


def test_own_autocast_inside_a_caching_one():
    """Weights cast under no_grad by the snapshots must not be reused, without gradient, by the replays."""
    model, data = toy(), group(4, torch.float32)
    AcceleratorState._reset_state(reset_partial_state=True)
    step = GroupStep(model, accelerator=Accelerator(cpu=True, mixed_precision="bf16"))
    AcceleratorState._reset_state(reset_partial_state=True)
    step.accumulate(*data)
    want = gradients(model)
    model.zero_grad()
    with torch.autocast("cpu", torch.bfloat16):
        step.accumulate(*data)
    assert largest_error(gradients(model), want) == 0


# ---- what is refused, with .grad as it was ----


def refused(model, data, message, **kwargs):
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    with pytest.raises(ValueError, match=message) as error:
        GroupStep(model, **kwargs).accumulate(*data)
    assert "\n" not in str(error.value)
    assert all(torch.equal(p.grad, torch.ones_like(p)) for p in model.parameters())


def test_non_finite_prediction_names_the_image():
    model, data = toy(), group(5, torch.float32)
    with torch.no_grad():
        model.out.bias.fill_(math.nan)
    refused(model, (*data, ["a.png", "b.png", "c.png", "d.png", "e.png"]), r"prediction of a.png \(image 0\) has NaN")
    refused(model, data, "prediction of image 0 has NaN", retain=5)


def test_non_finite_gradient_leaves_gradients_alone():
    model, data = toy(), group(4, torch.float32)
    count = []

    def hook(gradient):
        count.append(None)
        return gradient * math.inf if len(count) == 2 else gradient

    model.out.weight.register_hook(hook)
    refused(model, data, "gradient of this group has NaN or infinite")


def test_failing_replay_leaves_gradients_alone():
    class Failing(Toy):
        def forward(self, pixel_values):
            if len(self.seen) == 3:
                raise ValueError("out of luck")
            return super().forward(pixel_values)

    refused(Failing(), group(4, torch.float32), "out of luck", retain=0)


def test_bad_groups():
    model, (pixels, mask, target, valid) = toy(), group(3, torch.float32)
    bad = target.clone()
    bad[1, 0, 0] = math.inf
    refused(model, (pixels, mask, bad), r"target \(proxy\) of image 1 has NaN or infinite")
    refused(model, (pixels, mask, bad, valid, ["x/0", "x/1", "x/2"]), r"target \(proxy\) of x/1")
    refused(model, (pixels * math.nan, mask, target), "pixel_values of image 0")
    refused(model, (pixels, mask[:2], target), "mask has 2 entries for 3 images")
    refused(model, (pixels, mask, target, valid, ["one"]), "names has 1 entries for 3 images")
    refused(model, (pixels.half(), mask, target), "not fp16")
    refused(model, (pixels[:0], mask[:0], target[:0]), "no images")
    refused(model, (pixels, mask.float(), target), "mask must be a bool tensor")
    half = slice(None, 14)
    refused(model, (pixels, mask[:, half], target[:, half]), "the prediction is 28x28 but mask and target are 14x28")


def test_bad_models():
    data = group(2, torch.float32)
    model = toy()
    model.forward = lambda pixel_values: nn.functional.conv2d(pixel_values, model.conv.weight, padding=1)
    refused(model, data, r"must predict \(2,H,W\)")
    refused(toy().half(), data, "fp16 parameters")
    with pytest.raises(ValueError, match="no trainable parameter"):
        GroupStep(toy().requires_grad_(False)).accumulate(*data)
    batch_norm = nn.Sequential(nn.BatchNorm2d(3), nn.Conv2d(3, 1, 1))
    with pytest.raises(ValueError, match="BatchNorm layer 0 is in training mode"):
        GroupStep(batch_norm)
    GroupStep(batch_norm.eval())


@pytest.mark.parametrize("layer", [nn.Dropout(0.1), nn.Dropout2d(0.5)])
def test_dropout_is_refused(layer):
    model = toy()
    step = GroupStep(model)
    model.add_module("noise", layer)
    refused(model, group(2, torch.float32), "dropout must be 0, but noise has p=")
    with pytest.raises(ValueError, match="dropout"):
        step.accumulate(*group(2, torch.float32))
    model.noise.p = 0.0
    GroupStep(model)


def test_lora_and_attention_dropout_are_refused():
    noisy = get_peft_model(tiny_model(), LoraConfig(target_modules=["q_proj"], lora_dropout=0.1))
    with pytest.raises(ValueError, match=r"q_proj.lora_dropout.default has p=0.1"):
        GroupStep(noisy)
    model = tiny_model()
    model.backbone.encoder.layer[0].attention.attention_dropout = 0.2
    with pytest.raises(ValueError, match=r"attention_dropout=0\.2"):
        GroupStep(model)


def test_bad_arguments():
    for kwargs, message in (
        ({"micro_batch_size": 0}, "micro_batch_size must be a positive integer"),
        ({"retain": -1}, "retain must be"),
        ({"retain": "all"}, "retain must be"),
        ({"retain": 1.5}, "retain must be"),
        ({"snapshot_micro_batch_size": 3, "retain": 0}, "multiple of micro_batch_size 2, got 3"),
        ({"snapshot_micro_batch_size": 0, "retain": 0}, "multiple of micro_batch_size"),
        ({"snapshot_micro_batch_size": 4}, "needs a fixed retain"),
    ):
        with pytest.raises(ValueError, match=message):
            GroupStep(toy(), **kwargs)


def test_fp16_and_ddp_are_refused():
    class Fp16:
        mixed_precision = "fp16"

    with pytest.raises(ValueError, match="mixed precision fp16 is not supported"):
        GroupStep(toy(), accelerator=Fp16())

    class Sharded:
        mixed_precision = "no"
        distributed_type = DistributedType.FSDP

    with pytest.raises(ValueError, match="FSDP is not supported"):
        GroupStep(toy(), accelerator=Sharded())
    wrapped = nn.parallel.DistributedDataParallel.__new__(nn.parallel.DistributedDataParallel)
    with pytest.raises(ValueError, match="DistributedDataParallel"):
        GroupStep(wrapped)


# ---- two processes ----

UPDATES = 20


def train(model, accelerator, dtype):
    """20 Adam updates on groups of changing size; the adapter's weights."""
    parameters = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(parameters, lr=2e-5)
    step = GroupStep(model, accelerator=accelerator)
    for update in range(UPDATES):
        step.accumulate(*group((5, 2, 3)[update % 3], dtype, seed=update))
        optimizer.step()
        optimizer.zero_grad()
    return {name: p.detach().clone() for name, p in model.named_parameters() if p.requires_grad}


def retained(name, count):
    """Whether a graph was kept matters to the bits alone, so one precision will do."""
    return (0, 2, count) if name == "float64" else (0,)


def message_of(function, *args):
    try:
        function(*args)
    except ValueError as error:
        return str(error)


def work(folder):
    """Everything that two processes are asked, in one launch; each process leaves its answers in a file."""
    AcceleratorState._reset_state(reset_partial_state=True)  # forked from a process that may have had its own
    GradientState._reset_state()
    torch.set_num_threads(1)
    accelerator = Accelerator(cpu=True)
    assert accelerator.num_processes == 2
    answers = {}
    for name, dtype in DTYPES.items():
        model = gift_model(dtype)
        for count in COUNTS:
            for cut in CUTS:
                data = group(count, dtype)
                runs = {r: step_gradients(model, cut, r, data, accelerator) for r in retained(name, count)}
                answers[name, count, cut] = runs
        answers[name, "trained"] = train(gift_model(dtype, spread=0), accelerator, dtype)

    answers["auto"] = [GroupStep(toy(), accelerator=accelerator).accumulate(*group(n, torch.float32)) for n in COUNTS]
    model, (pixels, mask, target, _) = toy(), group(2, torch.float32)
    for parameter in model.parameters():
        parameter.grad = torch.full_like(parameter, 100)
    step = GroupStep(model, accelerator=accelerator)
    step.accumulate(pixels, mask, target)  # one micro-batch: process 1 has none
    answers["on top"] = gradients(model)
    answers["size"] = message_of(step.accumulate, pixels, mask[:, :14], target[:, :14])
    with torch.no_grad():
        model.out.bias.fill_(math.inf)
    answers["infinite"] = message_of(step.accumulate, pixels, mask, target, None, ["left", "right"])
    answers["after errors"] = gradients(model)
    torch.save(answers, folder / f"{accelerator.process_index}.pt")


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """The answers of process 0 and of process 1."""
    folder = tmp_path_factory.mktemp("two")
    debug_launcher(work, (folder,), num_processes=2)
    return [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in (0, 1)]


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("count", COUNTS)
def test_two_processes_sum_to_the_gradient(two, model_of, count, cut):
    dtype = next(model_of.parameters()).dtype
    name = str(dtype).removeprefix("torch.")
    expected, want = step_gradients(model_of, cut, 0, group(count, dtype))
    runs, other_runs = (answers[name, count, cut] for answers in two)
    for retain, (output, got) in runs.items():
        other_output, other = other_runs[retain]
        assert output == other_output and largest_error(got, other) == 0
        assert largest_error(got, runs[0][1]) == 0  # whatever is retained
        assert largest_error(got, want) < (1e-10 if dtype == torch.float64 else 1e-6 * scale(want))
        assert output[:4] == expected[:4] and output.forwards == 2 * count - num_retained(count, cut, retain)


def work_of_three(folder, base_dir, tree):
    """Training, proxies and evaluation by three processes, with fewer micro-batches and groups than processes."""
    AcceleratorState._reset_state(reset_partial_state=True)
    GradientState._reset_state()
    torch.set_num_threads(1)
    accelerator = Accelerator(cpu=True)
    assert accelerator.num_processes == 3
    answers = {(name, "trained"): train(gift_model(d, spread=0), accelerator, d) for name, d in DTYPES.items()}
    proxies = {"size": (56, 70), "proxies_dir": folder / "proxies"}
    make_proxies(base_dir, tree, accelerator=accelerator, **proxies)
    rows = load_gift_i(tree, "train", teacher=base_dir, **proxies)
    report = evaluate_gift_i(rows, tiny_model(), accelerator=accelerator, processor=tiny_processor(), progress=False)
    answers["evaluation"] = report.gce, report.rows
    torch.save(answers, folder / f"{accelerator.process_index}.pt")


@pytest.fixture(scope="module")
def three(base_dir, tmp_path_factory):
    """(the answers of each process, their folder, the tree they looked at: groups of 2 and of 5 images)."""
    folder = tmp_path_factory.mktemp("three")
    tree = write_raw_tree(folder / "raw", train=(2, 5), validation=())
    list_of_rows = load_gift_i(tree, "train")  # the listing is cached by one process
    assert len(list_of_rows) == 2
    debug_launcher(work_of_three, (folder, base_dir, tree), num_processes=3)
    return [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in range(3)], folder, tree


@pytest.mark.parametrize(("name", "tolerance"), [("float64", 1e-9), ("float32", 1e-5)])
def test_two_and_three_processes_train_the_same_adapter(two, three, name, tolerance):
    model = gift_model(DTYPES[name], spread=0)
    start = {key: p.detach().clone() for key, p in model.named_parameters() if p.requires_grad}
    want = train(model, None, DTYPES[name])
    for processes in (two, three[0]):
        for answers in processes:
            assert largest_error(processes[0][name, "trained"], answers[name, "trained"]) == 0
        assert largest_error(processes[0][name, "trained"], want) < tolerance
    assert largest_error(start, want) > 1e-4  # it did train


def test_three_processes_share_proxies_and_evaluation(three, base_dir, tmp_path):
    processes, folder, tree = three
    options = {"size": (56, 70), "proxies_dir": tmp_path}
    make_proxies(base_dir, tree, **options)
    files = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*.safetensors"))
    assert len(files) == 2
    assert all((tmp_path / file).read_bytes() == (folder / "proxies" / file).read_bytes() for file in files)
    rows = load_gift_i(tree, "train", teacher=base_dir, **options)
    report = evaluate_gift_i(rows, tiny_model(), processor=tiny_processor(), progress=False)
    for answers in processes:
        assert repr(answers["evaluation"]) == repr((report.gce, report.rows))


def test_two_processes_add_this_group_only(two):
    model, data = toy(), group(2, torch.float32)
    GroupStep(model).accumulate(*data[:3])
    want = {name: g + 100 for name, g in gradients(model).items()} | {"unused": torch.full((3,), 100.0)}
    for answers in two:
        assert largest_error(answers["on top"], want) < 1e-5
        assert largest_error(answers["after errors"], answers["on top"]) == 0


def test_two_processes_retain_what_each_has_room_for(two):
    for answers in two:
        assert [output.forwards for output in answers["auto"]] == list(COUNTS)


def test_two_processes_raise_together(two):
    for answers in two:
        assert "the prediction is 28x28 but mask and target are 14x28" in answers["size"]
        assert "the prediction of left (image 0) has NaN or infinite values" in answers["infinite"]
