"""The grid of tokens as both runtimes work it out, in a process of their own.

OpenVINO keeps threads for as long as its process lives, and other tests fork: a process that did both crashed.
"""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import onnx_ir as ir

from gift_peft.deploy.token_grid import GRID, compute_grid

SESSIONS = {}  # of the process that runs them


class Grids:
    """Rows and columns by onnxruntime and by OpenVINO, of pictures of any size."""

    def __init__(self):
        self.pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))

    def __call__(self, tokens: int, sizes: list[tuple[int, int]]) -> list[list[tuple[int, int]]]:
        """For each (height, width) the two runtimes' (rows, columns)."""
        return self.pool.submit(_run, tokens, sizes).result()


def _sessions(tokens: int):
    import onnxruntime
    import openvino

    pixels = ir.val("pixel_values", dtype=ir.DataType.FLOAT, shape=ir.Shape(["batch", 3, "height", "width"]))
    grid = ir.val(GRID, dtype=ir.DataType.FLOAT, shape=ir.Shape(["rows", "columns"]))
    tape = ir.tape.Tape()
    shape = tape.op("Shape", [grid])
    shape.name, shape.dtype, shape.shape = "shape", ir.DataType.INT64, ir.Shape([2])
    graph = ir.Graph([pixels, grid], [shape], nodes=tape.nodes, opset_imports={"": 20}, name="grid")
    model = ir.Model(graph, ir_version=10)
    compute_grid(model, tokens)
    content = ir.to_proto(model).SerializeToString()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    core = openvino.Core()
    compiled = core.compile_model(core.read_model(content), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    return [lambda feeds: session.run(None, feeds)[0], lambda feeds: compiled(feeds)[0]]


def _run(tokens, sizes):
    if tokens not in SESSIONS:
        SESSIONS[tokens] = _sessions(tokens)
    found = []
    for height, width in sizes:
        feeds = {"pixel_values": np.zeros((1, 3, height, width), np.float32)}
        found.append([tuple(int(side) for side in run(feeds)) for run in SESSIONS[tokens]])
    return found
