"""Pre-train the embedded base model from scratch on the opaque renders: two million weights, inverse depth in 1/m.

    python examples/tools/embedded/render_base.py --out renders/base --count 5400
    python examples/tools/embedded/pretrain_base.py --out renders/first --scenes 2004 --steps 4500
    python examples/tools/embedded/pretrain_base.py --out renders/second --init renders/first/base --steps 900 \\
        --learning_rate 5e-4
    python examples/tools/embedded/render_base.py --out renders/near --count 200
    python examples/tools/embedded/render_base.py --out renders/near --count 4200 --first 4000
    python examples/tools/embedded/pretrain_base.py --renders renders/near --out renders/model \\
        --init renders/second/base --steps 1600 --learning_rate 6e-4

    python examples/tools/embedded/pretrain_base.py --renders renders/bare --out renders/bare_model --steps 1700

Weighted L1 and a multi-scale gradient loss on inverse depth, AdamW with a one-cycle schedule, flips and colour jitter,
an exponential average of the weights, bf16 autocast where the CPU has it; `torch.compile` needs a C++ compiler. The
first `--held_out` scene files (some are empty: no view turned out well) are never trained on; every 500 steps it
prints delta1 and AbsRel on them (affine alignment in inverse depth). It resumes from `--out/state.pt`.
"""

import argparse
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch.nn import functional as F
from tqdm import tqdm
from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config, DPTImageProcessor

from gift_peft import align, depth_metrics

SIZE = (112, 140)
BF16 = any(torch.cpu.get_capabilities().get(name) for name in ("avx512_bf16", "amx_bf16"))  # else emulated, slowly
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def build_model() -> DepthAnythingForDepthEstimation:
    backbone = Dinov2Config(
        hidden_size=144,
        num_hidden_layers=6,
        num_attention_heads=4,
        mlp_ratio=3,
        image_size=SIZE[1],
        patch_size=14,
        out_indices=[2, 3, 5, 6],
        reshape_hidden_states=False,
        apply_layernorm=True,
        layerscale_value=0.1,
    )
    model = DepthAnythingForDepthEstimation(
        DepthAnythingConfig(
            backbone_config=backbone,
            reassemble_hidden_size=144,
            patch_size=14,
            neck_hidden_sizes=[32, 48, 64, 96],
            fusion_hidden_size=40,
            head_hidden_size=24,
            depth_estimation_type="relative",
        )
    )
    for module in (*model.neck.modules(), *model.head.modules()):  # transformers' 0.02 lets narrow layers fall silent
        if isinstance(module, (torch.nn.Conv2d, torch.nn.ConvTranspose2d)):
            module.reset_parameters()
    with torch.no_grad():  # start from a plausible constant, away from the final ReLU's dead side
        model.head.conv3.weight.abs_()
        model.head.conv3.bias.fill_(0.3)
    return model


def build_processor() -> DPTImageProcessor:
    return DPTImageProcessor(
        size={"height": SIZE[0], "width": SIZE[1]},
        keep_aspect_ratio=False,
        ensure_multiple_of=14,
        resample=Image.Resampling.BICUBIC,
        image_mean=list(MEAN),
        image_std=list(STD),
    )


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Pictures (V, 112, 140, 3) uint8 and inverse depth (V, 112, 140) in 1/m of one scene file."""
    with np.load(path) as scene:
        pictures, depths = scene["image"], scene["depth"]
    height, width = SIZE
    small = [np.asarray(Image.fromarray(p).resize((width, height), Image.Resampling.BICUBIC)) for p in pictures]
    inverse = [
        F.interpolate(torch.from_numpy(1000.0 / d.astype(np.float32))[None, None], SIZE, mode="area")[0, 0].numpy()
        for d in depths
    ]
    if not small:
        return np.zeros((0, *SIZE, 3), np.uint8), np.zeros((0, *SIZE), np.float16)
    return np.stack(small), np.stack(inverse).astype(np.float16)


def load(paths: list[Path]) -> tuple[torch.Tensor, torch.Tensor]:
    with ThreadPoolExecutor(2) as pool:
        scenes = list(tqdm(pool.map(read, paths), total=len(paths), unit="scene", desc="reading"))
    pictures, inverse = (np.concatenate(part) for part in zip(*scenes, strict=True))
    return torch.from_numpy(pictures), torch.from_numpy(inverse)


def normalise(pictures: torch.Tensor) -> torch.Tensor:
    """(B, H, W, 3) in 0..1 to (B, 3, H, W)."""
    return ((pictures - torch.tensor(MEAN)) / torch.tensor(STD)).permute(0, 3, 1, 2)


def augment(pictures: torch.Tensor, inverse: torch.Tensor, generator) -> tuple[torch.Tensor, torch.Tensor]:
    count = len(pictures)

    def draw(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=generator)

    x = pictures.float() / 255
    x = x.clamp_min(1e-4) ** draw(0.75, 1.3, count, 1, 1, 1)
    x = x * draw(0.75, 1.25, count, 1, 1, 1) * draw(0.92, 1.08, count, 1, 1, 3)
    grey = x.mean(-1, keepdim=True)
    x = grey + (x - grey) * draw(0.6, 1.4, count, 1, 1, 1)
    x = x + torch.randn(x.shape, generator=generator) * draw(0.0, 0.015, count, 1, 1, 1)
    flip = torch.rand(count, generator=generator) < 0.5
    x[flip], inverse = x[flip].flip(2), inverse.float().clone()
    inverse[flip] = inverse[flip].flip(2)
    return normalise(x.clamp(0, 1)), inverse


def loss_function(prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Relative L1 on inverse depth and on its gradients at four scales."""
    weight = 1 / (target + 0.15)
    loss = ((prediction - target).abs() * weight).mean()
    error = (prediction - target) * weight
    for _ in range(4):
        loss = loss + 0.25 * (
            (error[:, 1:] - error[:, :-1]).abs().mean() + (error[..., 1:] - error[..., :-1]).abs().mean()
        )
        error = F.avg_pool2d(error, 2)
    return loss


@torch.no_grad()
def score(model, pictures, inverse) -> dict[str, float]:
    """Image means of delta1 (percent) and AbsRel after affine alignment in inverse depth."""
    model.eval()
    rows = []
    for index in range(0, len(pictures), 16):
        with torch.autocast("cpu", torch.bfloat16, enabled=BF16):
            output = model(pixel_values=normalise(pictures[index : index + 16].float() / 255)).predicted_depth
        for predicted, true in zip(output.float().numpy(), inverse[index : index + 16].float().numpy(), strict=True):
            depth = 1000.0 / true
            everywhere = np.ones(depth.shape, bool)
            fitted = align(predicted, depth, everywhere, "gift", "inverse_depth")
            rows.append(depth_metrics(fitted.aligned, depth, everywhere))
    return {name: float(np.mean([row[name] for row in rows])) for name in ("delta1", "abs_rel")}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--renders", type=Path, default=Path("renders/base"))
    parser.add_argument("--out", type=Path, default=Path("renders/model"))
    parser.add_argument("--steps", type=int, default=4500)
    parser.add_argument("--batch", type=int, default=24)
    parser.add_argument("--learning_rate", type=float, default=1.2e-3)
    parser.add_argument("--scenes", type=int, help="use the first so many scenes only; default: all")
    parser.add_argument("--init", type=Path, help="start from this model instead of from scratch")
    parser.add_argument("--held_out", type=int, default=100, help="scenes")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)

    paths = sorted(args.renders.glob("[0-9]*[0-9].npz"))[: args.scenes]
    pictures, inverse = load(paths[args.held_out :])
    test = load(paths[: args.held_out])
    torch.manual_seed(args.seed)
    model = DepthAnythingForDepthEstimation.from_pretrained(args.init) if args.init else build_model()
    model = model.to(memory_format=torch.channels_last)  # convolutions are faster so
    average = build_model().to(memory_format=torch.channels_last)
    average.load_state_dict(model.state_dict())
    print(f"{sum(p.numel() for p in model.parameters()) / 1e6:.2f} M weights, {len(pictures)} pictures")
    optimizer = torch.optim.AdamW(model.parameters(), lr=args.learning_rate, weight_decay=0.03, betas=(0.9, 0.98))
    scheduler = torch.optim.lr_scheduler.OneCycleLR(optimizer, args.learning_rate, args.steps + 1, pct_start=0.08)
    step, state_file = 0, args.out / "state.pt"
    if state_file.exists():
        state = torch.load(state_file, weights_only=True)
        for name, part in (("model", model), ("average", average), ("optimizer", optimizer), ("scheduler", scheduler)):
            part.load_state_dict(state[name])
        step = state["step"]
    forward = torch.compile(model)  # a quarter faster on two cores
    started = time.time()
    while step < args.steps:
        generator = torch.Generator().manual_seed(args.seed * 1_000_003 + step)
        chosen = torch.randint(len(pictures), (args.batch,), generator=generator)
        x, target = augment(pictures[chosen], inverse[chosen], generator)
        model.train()
        with torch.autocast("cpu", torch.bfloat16, enabled=BF16):
            prediction = forward(pixel_values=x.contiguous(memory_format=torch.channels_last)).predicted_depth
        loss = loss_function(prediction.float(), target)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        scheduler.step()
        step += 1
        decay = min(0.998, step / (step + 50))
        with torch.no_grad():
            for slow, fast in zip(average.parameters(), model.parameters(), strict=True):
                slow.lerp_(fast, 1 - decay)
        if step % 50 == 0:
            print(f"step {step} loss {loss.item():.4f} {time.time() - started:.0f} s", flush=True)
        if step % 500 == 0 or step == args.steps:
            print(f"step {step} held out {score(average, *test)}", flush=True)
            parts = {"model": model, "average": average, "optimizer": optimizer, "scheduler": scheduler}
            temporary = state_file.with_suffix(".part")
            torch.save({name: part.state_dict() for name, part in parts.items()} | {"step": step}, temporary)
            os.replace(temporary, state_file)
            average.eval().save_pretrained(args.out / "base")
            build_processor().save_pretrained(args.out / "base")


if __name__ == "__main__":
    main()
