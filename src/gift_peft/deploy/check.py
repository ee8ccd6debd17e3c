"""Does a runtime compute what torch computed? Compares outputs with the pairs of `reference.npz`, and says where not.

    python check.py                         the model beside this file, by onnxruntime or OpenVINO
    python check.py --write-inputs inputs   the inputs as .npy and raw .bin files, for any other runtime
    python check.py outputs                 what that runtime made of them: output_0.npy ..., or .npz, or the JSON
                                            files of TensorRT's `trtexec --exportOutput`

`gift-peft deploy` copies this file beside the model. It needs numpy alone.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

TOLERANCE = 1e-5  # largest difference relative to the mean of the reference: float32, and a shared order of magnitude
HALF = 5e-3  # what 16-bit arithmetic costs


def differences(reference: Mapping[str, np.ndarray], outputs: Sequence[np.ndarray | None]) -> list[tuple[float, str]]:
    """Per pair: the largest difference relative to the reference's mean (infinite if it cannot be told), and in words.

    Args:
        reference: `output_0`, `output_1`, ... (B,h,w).
        outputs: what a runtime computed; None where it computed nothing.
    """
    expected = [reference[f"output_{index}"] for index in range(len(outputs))]
    return [_difference(index, expected, output, outputs) for index, output in enumerate(outputs)]


def _difference(index: int, expected: list[np.ndarray], output: np.ndarray | None, outputs) -> tuple[float, str]:
    right = expected[index]
    if output is None:
        return np.inf, "no output"
    output = np.asarray(output)
    if [side for side in output.shape if side > 1] == [side for side in right.shape if side > 1]:
        output = output.reshape(right.shape)  # a channel of one, or no batch
    if output.shape != right.shape:
        same = [other for other in outputs if other is not None and np.shape(other) == output.shape]
        hint = "; every output has this size: the graph keeps the size it was traced at" if len(same) > 1 else ""
        return np.inf, f"shape {_size(output.shape)} in place of {_size(right.shape)}{hint}"
    if not np.isfinite(output).all():
        where = np.argwhere(~np.isfinite(output))
        return np.inf, f"{len(where)} of {output.size} values are NaN or infinite, the first at {_place(where[0])}"
    output, right = output.astype(np.float64), right.astype(np.float64)
    scale = max(np.abs(right).mean(), 1e-30)
    errors = np.abs(output - right) / scale
    worst = float(errors.max())
    place = _place(np.unravel_index(int(errors.argmax()), errors.shape))
    text = f"largest difference {worst:.1e} of the mean at {place}, on average {errors.mean():.1e}"
    return worst, text + (f"; {hint}" if worst > TOLERANCE and (hint := _hint(index, output, expected, worst)) else "")


def _hint(index: int, output: np.ndarray, expected: list[np.ndarray], worst: float) -> str:
    """What a wrong output looks like."""
    right = expected[index].astype(np.float64)
    if not output.any():
        return "all zero"
    if np.ptp(output) < 1e-6 * max(abs(output.mean()), 1e-30):
        return "the same number everywhere: did the input arrive?"
    if worst < HALF:
        return "of the size that 16-bit or 8-bit arithmetic makes"
    for other, pair in enumerate(expected):
        if other != index and pair.shape == output.shape and np.allclose(pair, output, rtol=1e-3):
            return f"it is the reference of pair {other}: are the inputs in order?"
    for name, turned in (("upside down", right[:, ::-1]), ("mirrored", right[..., ::-1])):
        if np.allclose(turned, output, rtol=1e-3):
            return name
    factor = float((output * right).sum() / max((right * right).sum(), 1e-30))
    if np.abs(output - factor * right).max() < 1e-3 * np.abs(output).mean():
        return f"the reference times {factor:.4g}"
    bad = np.abs(output - right) > 1e-3 * np.abs(right).mean()
    rows, columns = np.flatnonzero(bad.any(axis=(0, 2))), np.flatnonzero(bad.any(axis=(0, 1)))
    return (
        f"{100 * bad.mean():.0f} % of the pixels differ, rows {rows[0]}-{rows[-1]}, columns {columns[0]}-{columns[-1]}"
    )


def _size(shape: Sequence[int]) -> str:
    return "x".join(map(str, shape))


def _place(index: Sequence[int]) -> str:
    image, row, column = (0, 0, 0, *map(int, index))[-3:]
    return f"picture {image}, row {row}, column {column}"


# ---- stored outputs ----


def read_outputs(source: Path, count: int) -> list[np.ndarray | None]:
    """Outputs 0 to count-1 of a folder or .npz with `output_<n>`, or one file of `trtexec` per pair in a folder.

    None where one is missing. Raises FileNotFoundError, ValueError.
    """
    if not source.exists():
        raise FileNotFoundError(f"{source}: no such file or folder")
    if source.is_file() and source.suffix == ".npz":
        with np.load(source) as stored:
            return [stored[name] if (name := f"output_{index}") in stored else None for index in range(count)]
    if source.is_file():
        raise ValueError(f"{source}: a folder of output_0.npy ... or output_0.json ..., or an .npz is expected")
    return [_read_output(source, index) for index in range(count)]


def _read_output(folder: Path, index: int) -> np.ndarray | None:
    array, table = folder / f"output_{index}.npy", folder / f"output_{index}.json"
    if array.is_file():
        return np.load(array)
    if not table.is_file():
        return None
    try:  # trtexec: [{"name": ..., "dimensions": "1x518x518", "values": [...]}]
        entry = json.loads(table.read_text(encoding="utf-8"))[0]
        return np.array(entry["values"], np.float32).reshape([int(n) for n in entry["dimensions"].split("x")])
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise ValueError(f"{table}: not what `trtexec --exportOutput` writes ({error})") from None


def write_inputs(reference: Mapping[str, np.ndarray], folder: Path) -> None:
    """input_<n>.npy and input_<n>.bin (float32, as `trtexec --loadInputs` reads them)."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in filter(lambda key: key.startswith(("input_", "adapter_scale_")), reference):
        np.save(folder / f"{name}.npy", reference[name])
        (folder / f"{name}.bin").write_bytes(np.ascontiguousarray(reference[name], np.float32).tobytes())
        print(f"{folder / name}.npy and .bin: {_size(reference[name].shape)} float32")


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "outputs", nargs="?", help="outputs of another runtime; default: run the model beside this file"
    )
    parser.add_argument("--backend", choices=["onnx", "openvino"], help="which runtime, where none are given")
    parser.add_argument("--write-inputs", metavar="DIR", help="write the inputs for another runtime, and end")
    parser.add_argument(
        "--tolerance", type=float, help="largest difference relative to the mean (default: as exported)"
    )
    args = parser.parse_args(argv)
    here = Path(__file__).parent
    try:
        with np.load(here / "reference.npz") as pairs:
            reference = {name: pairs[name] for name in pairs.files}
        if args.write_inputs:
            write_inputs(reference, Path(args.write_inputs))
            return 0
        count = sum(name.startswith("output_") for name in reference)
        outputs = (
            read_outputs(Path(args.outputs), count) if args.outputs else _run(here, args.backend, reference, count)
        )
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    tolerance = float(reference["tolerance"]) if args.tolerance is None else args.tolerance
    wrong = 0
    for index, (worst, text) in enumerate(differences(reference, outputs)):
        fine = worst <= tolerance
        wrong += not fine
        print(f"pair {index} ({_size(reference[f'input_{index}'].shape)}): {'right' if fine else 'WRONG'}, {text}")
    print("right" if not wrong else f"{wrong} of {count} pairs are wrong (tolerance {tolerance:.0e})")
    return int(wrong > 0)


def _run(here: Path, backend: str | None, reference: Mapping[str, np.ndarray], count: int) -> list[np.ndarray | None]:
    from predictor import Predictor  # beside this file

    predictor = Predictor(here, backend)
    if str(reference["model_id"]) != predictor.settings["model_id"]:
        raise ValueError("reference.npz is of another export than the model beside it")
    return [
        predictor.predict(reference[f"input_{k}"], _scale(reference.get(f"adapter_scale_{k}"))) for k in range(count)
    ]


def _scale(value: np.ndarray | None) -> float | None:
    return None if value is None else float(np.ravel(value)[0])


if __name__ == "__main__":
    sys.exit(main())
