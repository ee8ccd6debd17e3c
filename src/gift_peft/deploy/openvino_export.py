"""`gift-peft deploy --to openvino`: the graph of `onnx_export`, read by OpenVINO and written in its own format.

OpenVINO's own conversion of a torch module keeps the size it was traced at, so the way leads over ONNX.
"""

import tempfile
from pathlib import Path
from typing import Any

from gift_peft.deploy.bundle import OWN, prepare_bundle, write_bundle
from gift_peft.deploy.onnx_export import require_onnx, write_onnx
from gift_peft.deploy.runtime import MODEL_ID
from gift_peft.deploy.stages import stages
from gift_peft.files import reason, whole_folder


def deploy_openvino(adapter: str | Path, out: str | Path, base: str | Path | None = None, **options: Any) -> Path:
    """Write `out` with model.xml, model.bin (float32) and what they need elsewhere; returns it.

    Args and errors: as `deploy_onnx`, and ValueError if OpenVINO is not installed or does not read the graph.
    """
    require_onnx()
    try:
        import openvino
    except ImportError:
        raise ValueError('OpenVINO is not installed: pip install "gift-peft[openvino]"') from None
    with stages(4) as stage:
        stage("the model")
        bundle = prepare_bundle(adapter, out, base, "openvino", **options)
        with whole_folder(bundle.out, OWN) as folder:
            stage("its graph, a minute for small and several for large models")
            with tempfile.TemporaryDirectory(dir=folder) as scratch:
                write_onnx(bundle, Path(scratch) / "model.onnx")
                stage("OpenVINO")
                try:
                    model = openvino.Core().read_model(Path(scratch) / "model.onnx")
                    model.set_rt_info(bundle.settings["model_id"], MODEL_ID)
                    openvino.save_model(model, folder / "model.xml", compress_to_fp16=False)
                except RuntimeError as error:
                    raise ValueError(f"{bundle.name}: OpenVINO does not read the graph: {reason(error)}") from None
                del model  # it reads its weights from the scratch folder
            stage("comparison with torch")
            write_bundle(bundle, folder, "openvino")
    return bundle.out
