"""`gift-peft deploy --to onnx` and `--to int8`: a graph that is right at every size and batch.

The ordinary ways of exporting these networks run at other sizes than the traced one and give a wrong map, without an
error. This is the one that was measured to be right: `torch.export` in strict mode with named sizes, then
`torch.onnx.export` of its program, with `interpolate` as matrices. Every export is compared with torch at three sizes
before its folder appears.
"""

import contextlib
import io
import logging
import math
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn
from tqdm import tqdm

from gift_peft.deploy.bundle import OWN, Bundle, prepare_bundle, write_bundle
from gift_peft.deploy.dial import INPUT
from gift_peft.deploy.resampling import resampled_by_matrices
from gift_peft.deploy.runtime import MODEL_ID
from gift_peft.deploy.stages import stages
from gift_peft.deploy.token_grid import GRID, compute_grid, grid_in_graph, tokens_of
from gift_peft.files import reason, whole_folder

OPSET = 20  # the first with Gelu
TRACED = 8, 10  # patches; neither square nor a size that anybody asks for
TRACED_GRID = 6, 9  # of tokens, where a network takes others than the picture's patches
INT8_ERROR = 0.005  # mean error on the reference pictures, relative to the mean of the output
INT8_PARTS = 24  # of a network whose whole costs more than that


def deploy_onnx(adapter: str | Path, out: str | Path, base: str | Path | None = None, **options: Any) -> Path:
    """Write `out` with model.onnx and what it needs elsewhere; returns it.

    Args:
        adapter, base: as in `load_for_deployment`, and `options` as well.
        out: new folder, or one that `deploy` wrote.
        dial (`bool`, in `options`): a second input `adapter_scale`.

    Raises as `load_for_deployment` and `merged`, and ValueError if onnx is not installed, the network has an operation
    that cannot be exported, or the graph is not right.
    """
    return _deploy(adapter, out, base, int8=False, **options)


def deploy_int8(adapter: str | Path, out: str | Path, base: str | Path | None = None, **options: Any) -> Path:
    """`deploy_onnx` with weights of 8 bits (dynamic quantization); the mean error is at most 0.5 % of the mean.

    Where matrices and convolutions together cost more, a part of them stays float32.
    """
    return _deploy(adapter, out, base, int8=True, **options)


def _deploy(adapter: str | Path, out: str | Path, base: Any, int8: bool, **options: Any) -> Path:
    require_onnx()
    with stages(4 if int8 else 3) as stage:
        stage("the model")
        bundle = prepare_bundle(adapter, out, base, "int8" if int8 else "onnx", **options)
        with whole_folder(bundle.out, OWN) as temporary:
            stage("its graph, a minute for small and several for large models")
            write_onnx(bundle, temporary / "model.onnx")
            if int8:
                stage("8 bits")
                bundle.write_settings(temporary)
                quantize(bundle, temporary)
            stage("comparison with torch")
            write_bundle(bundle, temporary, "onnx")
    return bundle.out


def require_onnx() -> None:
    """ValueError, with what to install, unless onnx, onnxscript and onnxruntime are there."""
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ValueError(f'{error.name} is not installed: pip install "gift-peft[onnx]"') from None


def write_onnx(bundle: Bundle, path: Path) -> None:
    """The network of a bundle as an ONNX file (weights above 2 GB in a file beside it)."""
    network = bundle.network
    program = exported_program(network, bundle.multiple, bundle.dial, bundle.name)
    tokens = tokens_of(network)
    names = ["pixel_values", *([INPUT] if bundle.dial else []), *([] if tokens is None else [GRID])]
    try:
        with _quietly():
            graph = torch.onnx.export(
                program, dynamo=True, opset_version=OPSET, input_names=names, output_names=["predicted_depth"]
            )
    except Exception as error:  # its errors have no common class
        raise ValueError(f"{bundle.name} cannot be exported to ONNX: {failed_operation(error)}") from None
    if tokens is not None:
        compute_grid(graph.model, tokens)
    _name_sizes(graph.model)
    graph.model.metadata_props[MODEL_ID] = bundle.settings["model_id"]
    graph.save(path)


def exported_program(network: nn.Module, multiple: int, dial: bool, name: str) -> torch.export.ExportedProgram:
    """`torch.export` of a network of pixel values (a scale, a grid of tokens), for any batch and sides in patches.

    Raises ValueError with the operation that cannot be exported.
    """
    height, width = (multiple * side for side in TRACED)
    inputs: tuple[torch.Tensor, ...] = (torch.rand(2, 3, height, width),)
    batch = torch.export.Dim("batch", min=1)
    rows, columns = (torch.export.Dim(side, min=2) for side in ("rows", "columns"))
    sides = (rows, columns) if multiple == 1 else (multiple * rows, multiple * columns)
    sizes: dict[str, Any] = {"pixel_values": {0: batch, 2: sides[0], 3: sides[1]}}
    if dial:
        inputs, sizes = (*inputs, torch.ones(1)), sizes | {INPUT: None}
    if tokens_of(network) is not None:
        token_sides = {axis: torch.export.Dim(f"token_{side}", min=1) for axis, side in enumerate(("rows", "columns"))}
        inputs, sizes = (*inputs, torch.zeros(TRACED_GRID)), sizes | {GRID: token_sides}
    try:
        with torch.no_grad(), resampled_by_matrices(), grid_in_graph(network), _quietly():
            return torch.export.export(network, inputs, dynamic_shapes=sizes, strict=True)
    except Exception as error:  # dynamo's errors have no common class
        raise ValueError(f"{name} cannot be exported for every size: {failed_operation(error)}") from None


def failed_operation(error: BaseException) -> str:
    """The operation that an exporter's error is about, in one line."""
    text = str(error)
    if "Exception summary" in text:  # torch.onnx tells what to do next; what happened is what it was raised from
        while error.__cause__ is not None:
            error = error.__cause__
        return reason(error)[:300]
    operation = re.search(r"\b(?:aten|torchvision|prims)(?:\.|::)\w+", text)
    source = re.findall(r'File "([^"]+)", line (\d+), in \w+\n\s+(\S.*)', text)
    where = f"{Path(source[-1][0]).name}:{source[-1][1]}: {source[-1][2].strip()}" if source else ""
    return "; ".join(filter(None, [operation and operation[0], where, reason(error)]))[:300]


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """The exporters' warnings and prints are about their own parts, and many."""
    logging.disable(logging.CRITICAL)
    try:
        printed = io.StringIO()
        with warnings.catch_warnings(), contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logging.NOTSET)


def _name_sizes(model: Any) -> None:
    """Readable names of the free sizes, in place of the exporter's symbols, for the graph's inputs and output."""
    import onnx_ir

    pixels = next(value for value in model.graph.inputs if value.name == "pixel_values")
    (depth,) = model.graph.outputs
    as_input = [str(side) for side in depth.shape[1:]] == [str(side) for side in pixels.shape[2:]]
    pixels.shape = onnx_ir.Shape(["batch", 3, "height", "width"])
    depth.shape = onnx_ir.Shape(["batch", *(["height", "width"] if as_input else ["depth_height", "depth_width"])])


# ---- 8 bits ----


def quantize(bundle: Bundle, folder: Path) -> None:
    """Replace model.onnx by its form with weights of 8 bits.

    All matrices and convolutions, or the matrices alone; where both cost more than 0.5 % of the output's mean, as many
    parts as stay below it, by what each costs alone. Raises ValueError where no part does.
    """
    import onnx

    whole = folder / "whole.onnx"
    large = (folder / "model.onnx.data").exists()
    onnx.save(onnx.load(folder / "model.onnx"), whole, save_as_external_data=large, location="whole.onnx.data")
    weights = _weights(onnx.load(whole, load_external_data=False).graph)

    def error(chosen: Sequence[str]) -> float:
        _write_int8(whole, folder, chosen, large)
        return bundle.mean_error(bundle.outputs(folder, "onnx"))

    matrices = [name for name, (kind, _) in weights.items() if kind != "Conv"]
    chosen = next((names for names in ([*weights], matrices) if names and error(names) <= INT8_ERROR), None)
    if chosen is None:
        chosen = _affordable(weights, error)
    for file in folder.glob("whole.onnx*"):
        file.unlink()
    if not chosen:
        raise ValueError(
            f"{bundle.name}: 8 bits cost more than 0.5 % of the output's mean in every part; take --to onnx"
        )
    share = sum(weights[name][1] for name in chosen) / sum(size for _, size in weights.values())
    bundle.settings["made_from"]["share_of_weights_in_8_bits"] = round(share, 3)


def _weights(graph: Any) -> dict[str, tuple[str, int]]:
    """{node: (operation, numbers)} of the matrices and convolutions whose weights are constants."""
    constants = {tensor.name: tensor.dims for tensor in graph.initializer}
    found = {}
    for node in graph.node:
        shape = constants.get(node.input[1]) if node.op_type in ("MatMul", "Gemm", "Conv") else None
        # A constant of more dimensions is no weight of a matrix but the table of positions, which is resized.
        if shape is not None and (node.op_type == "Conv" or len(shape) == 2):
            found[node.name] = (node.op_type, math.prod(shape))
    return found


def _write_int8(whole: Path, folder: Path, nodes: Sequence[str], large: bool) -> None:
    from onnxruntime.quantization import QuantType, quantize_dynamic

    for file in folder.glob("model.onnx*"):
        file.unlink()
    with _quietly():
        quantize_dynamic(
            whole,
            folder / "model.onnx",
            nodes_to_quantize=list(nodes),
            per_channel=True,
            weight_type=QuantType.QInt8,
            use_external_data_format=large,
            extra_options={"MatMulConstBOnly": True},  # two activations stay float
        )


def _affordable(weights: dict[str, tuple[str, int]], error: Callable[[Sequence[str]], float]) -> list[str]:
    """The nodes of the parts that together stay below the limit; their errors add up as squares."""
    names = [*weights]
    step = -(-len(names) // INT8_PARTS)
    parts = [names[start : start + step] for start in range(0, len(names), step)]
    costs = [error(part) for part in tqdm(parts, desc="8 bits, part by part", leave=False)]
    sizes = [sum(weights[name][1] for name in part) for part in parts]
    order = sorted(range(len(parts)), key=lambda index: costs[index] ** 2 / sizes[index])
    taken: list[int] = []
    for index in order:
        if math.sqrt(sum(costs[other] ** 2 for other in [*taken, index])) <= INT8_ERROR:
            taken.append(index)
    while taken:
        chosen = [name for index in sorted(taken) for name in parts[index]]
        if error(chosen) <= INT8_ERROR:
            return chosen
        taken.remove(max(taken, key=lambda index: costs[index]))
    return []
