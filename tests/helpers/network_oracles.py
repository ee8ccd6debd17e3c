"""VGGT's depth path and Metric3D V2 as straight lines of arithmetic over a dict of official tensors.

Written from descriptions of the networks, sharing no code with gift_peft.models: attention and norms are spelled out,
rotations are complex products, resizing is a matrix per axis. Slow, and meant to be run in float64.
"""

import math

import torch
from torch.nn.functional import conv2d, conv_transpose2d, pad

# ---- pieces that both have ----


def linear(w, name, x):
    y = x @ w[f"{name}.weight"].T
    return y + w[f"{name}.bias"] if f"{name}.bias" in w else y


def conv(w, name, x, **options):
    return conv2d(x, w[f"{name}.weight"], w.get(f"{name}.bias"), **options)


def conv3(w, name, x):
    return conv(w, name, x, padding=1)


def layer_norm(w, name, x, eps):
    """Over the last axis."""
    x = x - x.mean(-1, keepdim=True)
    x = x / ((x * x).mean(-1, keepdim=True) + eps).sqrt()
    return x * w[f"{name}.weight"] + w[f"{name}.bias"]


def gelu(x):
    return 0.5 * x * (1 + torch.erf(x / math.sqrt(2)))


def relu(x):
    return x.clamp(min=0)


def attention(q, k, v):
    """(heads, N, d) each."""
    scores = torch.einsum("hid,hjd->hij", q, k) / math.sqrt(q.shape[-1])
    scores = (scores - scores.amax(-1, keepdim=True)).exp()
    return torch.einsum("hij,hjd->hid", scores / scores.sum(-1, keepdim=True), v)


def heads(w, name, x, count):
    """q, k, v of tokens (N, C), each (heads, N, d)."""
    rows = linear(w, f"{name}.qkv", x)
    return [part.reshape(len(x), count, -1).transpose(0, 1) for part in rows.split(x.shape[1], dim=1)]


def block(w, name, x, count, eps, turn=None, norm_qk=False, swiglu=False):
    """A pre-norm transformer block on tokens (N, C)."""
    q, k, v = heads(w, f"{name}.attn", layer_norm(w, f"{name}.norm1", x, eps), count)
    if norm_qk:
        q = layer_norm(w, f"{name}.attn.q_norm", q, 1e-5)
        k = layer_norm(w, f"{name}.attn.k_norm", k, 1e-5)
    if turn is not None:
        q, k = turn(q), turn(k)
    y = attention(q, k, v).transpose(0, 1).reshape(len(x), -1)
    x = x + linear(w, f"{name}.attn.proj", y) * w[f"{name}.ls1.gamma"]
    y = layer_norm(w, f"{name}.norm2", x, eps)
    if swiglu:
        gate, value = linear(w, f"{name}.mlp.w12", y).tensor_split(2, dim=-1)
        y = linear(w, f"{name}.mlp.w3", gate / (1 + (-gate).exp()) * value)
    else:
        y = linear(w, f"{name}.mlp.fc2", gelu(linear(w, f"{name}.mlp.fc1", y)))
    return x + y * w[f"{name}.ls2.gamma"]


def along_axes(x, rows, columns):
    """Resize (..., H, W) by a matrix per axis."""
    return torch.einsum("ih,...hw,jw->...ij", rows, x, columns)


def corners(size, target):
    """Bilinear weights (target, size) that keep the corners in place."""
    matrix = torch.zeros(target, size, dtype=torch.float64)
    for i in range(target):
        at = i * (size - 1) / (target - 1) if target > 1 else 0.0
        low = min(int(at), size - 1)
        matrix[i, low] += 1 - (at - low)
        matrix[i, min(low + 1, size - 1)] += at - low
    return matrix


def half_pixel(size, target):
    """Bilinear weights (target, size) without antialias, pixels as areas."""
    matrix = torch.zeros(target, size, dtype=torch.float64)
    for i in range(target):
        at = max((i + 0.5) * size / target - 0.5, 0.0)
        low = min(int(at), size - 1)
        matrix[i, low] += 1 - (at - low)
        matrix[i, min(low + 1, size - 1)] += at - low
    return matrix


def keys(x, a):
    """Keys' cubic kernel at x."""
    x = abs(x)
    if x <= 1:
        return (a + 2) * x**3 - (a + 3) * x**2 + 1
    return a * (x**3 - 5 * x**2 + 8 * x - 4) if x < 2 else 0.0


def cubic_scaled(size, target, scale):
    """Bicubic weights (target, size), a = -0.75, sampled `scale` sources apart, edges repeated, no antialias."""
    matrix = torch.zeros(target, size, dtype=torch.float64)
    for i in range(target):
        at = (i + 0.5) * scale - 0.5
        low = math.floor(at)
        for j in range(low - 1, low + 3):
            matrix[i, min(max(j, 0), size - 1)] += keys(at - j, -0.75)
    return matrix


def cubic_antialiased(size, target):
    """Bicubic weights (target, size), a = -0.5, the kernel widened when it shrinks, normalised at the edges."""
    scale = size / target
    width = max(scale, 1.0)
    matrix = torch.zeros(target, size, dtype=torch.float64)
    for i in range(target):
        centre = (i + 0.5) * scale
        for j in range(max(int(centre - 2 * width + 0.5), 0), min(int(centre + 2 * width + 0.5), size)):
            matrix[i, j] = keys((j + 0.5 - centre) / width, -0.5)
    return matrix / matrix.sum(1, keepdim=True)


def patches_of(w, name, image, side):
    """(h * w, C) of one image (3, H, W), row by row."""
    return conv(w, name, image[None], stride=side)[0].flatten(1).T


def vit_tokens(w, prefix, image, side, table, registers):
    """[cls, registers, patches] with the position table (h * w, C) on the patches."""
    name = "patch_embed.proj" if f"{prefix}.patch_embed.proj.weight" in w else "patch_embed.patch_embed.proj"
    patches = patches_of(w, f"{prefix}.{name}", image, side) + table
    cls = w[f"{prefix}.cls_token"][0] + w[f"{prefix}.pos_embed"][0, :1]
    return torch.cat([cls, w[f"{prefix}.register_tokens"][0], patches] if registers else [cls, patches])


# ---- VGGT ----


def vggt(w, config, images):
    """Depth and confidence, each (B, S, H, W), of images (B, S, 3, H, W) in [0, 1]."""
    return tuple(torch.stack(x) for x in zip(*(_scene(w, config, scene) for scene in images), strict=True))


def _scene(w, c, images):
    frames, _, height, width = images.shape
    grid = height // c.patch_size, width // c.patch_size
    count, special = grid[0] * grid[1], 1 + c.num_register_tokens
    x = torch.stack([_vggt_frame_tokens(w, c, image, grid, first=index == 0) for index, image in enumerate(images)])
    place = [(0, 0)] * special + [(1 + i, 1 + j) for i in range(grid[0]) for j in range(grid[1])]
    place = torch.tensor(place, dtype=torch.float64)

    def turn(x):
        """Rotary embedding of (heads, N, d); N may hold several frames."""
        at, quarter = place.repeat(x.shape[1] // len(place), 1), x.shape[2] // 4
        speed = float(c.rope_freq) ** (-torch.arange(quarter, dtype=torch.float64) / quarter)
        halves = []
        for axis, part in enumerate(x.split(2 * quarter, dim=2)):
            turned = torch.complex(part[..., :quarter], part[..., quarter:]) * torch.exp(
                1j * at[:, axis, None] * speed
            )
            halves += [turned.real, turned.imag]
        return torch.cat(halves, dim=2)

    outputs = []
    for index in range(c.depth):
        options = {"count": c.num_heads, "eps": 1e-5, "turn": turn, "norm_qk": c.qk_norm}
        within = torch.stack([block(w, f"aggregator.frame_blocks.{index}", frame, **options) for frame in x])
        x = block(w, f"aggregator.global_blocks.{index}", within.flatten(0, 1), **options).reshape(within.shape)
        outputs.append(torch.cat([within, x], dim=2))
    logits = [_vggt_head(w, c, [outputs[i][frame] for i in c.intermediate_layer_idx], grid, (height, width), count)
              for frame in range(frames)]  # fmt: skip
    logits = torch.stack(logits)
    return logits[:, 0].exp(), 1 + logits[:, 1].exp()


def _vggt_frame_tokens(w, c, image, grid, first):
    mean, std = (
        torch.tensor(v, dtype=image.dtype)[:, None, None] for v in ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225])
    )
    side, prefix = c.img_size // c.patch_size, "aggregator.patch_embed"
    table = w[f"{prefix}.pos_embed"][0, 1:]
    if grid != (side, side):
        table = table.T.reshape(-1, side, side)
        table = along_axes(table, cubic_antialiased(side, grid[0]), cubic_antialiased(side, grid[1])).flatten(1).T
    x = vit_tokens(w, prefix, (image - mean) / std, c.patch_size, table, c.num_register_tokens)
    for index in range(c.vit_depth):
        x = block(w, f"{prefix}.blocks.{index}", x, c.num_heads, 1e-6)
    x = layer_norm(w, f"{prefix}.norm", x, 1e-6)[1 + c.num_register_tokens :]
    own = 0 if first else 1
    return torch.cat([w["aggregator.camera_token"][0, own], w["aggregator.register_token"][0, own], x])


def _place_map(channels, rows, columns, image):
    diagonal = math.hypot(*image)
    result = torch.empty(channels, rows, columns, dtype=torch.float64)
    quarter = channels // 4
    for i in range(rows):
        for j in range(columns):
            u = image[1] / diagonal * (2 * j - (columns - 1)) / columns
            v = image[0] / diagonal * (2 * i - (rows - 1)) / rows
            waves = [
                f(at * 100 ** (-k / quarter)) for at in (u, v) for f in (math.sin, math.cos) for k in range(quarter)
            ]
            result[:, i, j] = torch.tensor(waves, dtype=torch.float64)
    return 0.1 * result


def _vggt_head(w, c, tokens, grid, image, count):
    p, maps = "depth_head", []
    for k, level in enumerate(tokens):
        x = layer_norm(w, f"{p}.norm", level[-count:], 1e-5).T.reshape(1, -1, *grid)
        x = conv(w, f"{p}.projects.{k}", x)
        x = x + _place_map(x.shape[1], *grid, image)
        name = f"{p}.resize_layers.{k}"
        if k < 2:
            x = conv_transpose2d(x, w[f"{name}.weight"], w[f"{name}.bias"], stride=(4, 2)[k])
        elif k == 3:
            x = conv(w, name, x, stride=2, padding=1)
        maps.append(conv3(w, f"{p}.scratch.layer{k + 1}_rn", x))

    def unit(name, x):
        x = relu(x)
        return x + conv3(w, f"{name}.conv2", relu(conv3(w, f"{name}.conv1", x)))

    x = None
    for level in (4, 3, 2, 1):
        name, finer = f"{p}.scratch.refinenet{level}", maps[level - 1]
        x = finer if x is None else x + unit(f"{name}.resConfUnit1", finer)
        x = unit(f"{name}.resConfUnit2", x)
        target = maps[level - 2].shape[2:] if level > 1 else (2 * finer.shape[2], 2 * finer.shape[3])
        x = along_axes(x, corners(x.shape[2], target[0]), corners(x.shape[3], target[1]))
        x = conv(w, f"{name}.out_conv", x)
    x = conv3(w, f"{p}.scratch.output_conv1", x)
    x = along_axes(x, corners(x.shape[2], image[0]), corners(x.shape[3], image[1]))
    x = x + _place_map(x.shape[1], *image, image)
    x = relu(conv3(w, f"{p}.scratch.output_conv2.0", x))
    return conv(w, f"{p}.scratch.output_conv2.2", x)[0]


# ---- Metric3D V2 ----


def metric3d(w, config, images):
    """Per image a list, initial state first, of (depth (H, W), confidence (H, W), normals (4, H, W))."""
    w = {name.removeprefix("depth_model."): value for name, value in w.items()}
    return [_metric3d_image(w, config, image) for image in images]


def _metric3d_image(w, c, image):
    grid = [math.ceil(side / c.patch_size) for side in image.shape[1:]]
    target = [side * c.patch_size for side in grid]
    if target != list(image.shape[1:]):
        image = along_axes(image, half_pixel(image.shape[1], target[0]), half_pixel(image.shape[2], target[1]))
    features = _metric3d_tokens(w, c, image, grid)

    def read(index, tokens):
        name, special = f"decoder.token2feature.read_{index}.readoper", 1 + c.num_register_tokens
        learned = linear(w, f"{name}.project_learn", tokens[:special].reshape(1, -1))
        x = gelu(linear(w, f"{name}.project_patch", tokens[special:]) + learned)
        return x.T.reshape(1, -1, *grid)

    reads = [read(index, tokens) for index, tokens in enumerate(features)]
    rows, columns = (torch.arange(int(3.5 * n)) * 2 // 7 for n in grid)
    read_0 = conv(w, "decoder.token2feature.read_0.sample.0", reads[0][:, :, rows][:, :, :, columns])
    up = "decoder.token2feature.read_1.sample"
    read_1 = conv_transpose2d(reads[1], w[f"{up}.weight"], w[f"{up}.bias"], stride=2)
    read_2, read_3 = reads[2], reads[3]

    def residual(name, x):
        x = relu(x)
        return x + conv3(w, f"{name}.conv2", relu(conv3(w, f"{name}.conv1", x)))

    def enlarge(x, scale):
        return along_axes(x, *(corners(n, int(n * scale)) for n in x.shape[2:]))

    p = "decoder.decoder_mono"
    x = conv(w, f"{p}.upconv_3.out_conv", residual(f"{p}.upconv_3.way_trunk", read_3))
    for name, skip, scale in (("upconv_2", read_2, 2), ("upconv_1", read_1, 1.75)):
        x = residual(f"{p}.{name}.way_trunk", x + residual(f"{p}.{name}.way_branch", skip))
        x = conv(w, f"{p}.{name}.out_conv", enlarge(x, scale))
    feature, depth_logit, normal_logit = x[:, :-2], x[:, -2:-1], x[:, -1:]

    def unit(xyz, kappa):
        length = (xyz * xyz).sum(1, keepdim=True).sqrt() + 1e-10
        kappa = torch.where(kappa > 0, kappa, kappa.clamp(max=0).exp() - 1) + 1 + 0.01
        return torch.cat([xyz / length, kappa], dim=1)

    logits = conv(w, "decoder.depth_regressor.2", relu(conv3(w, "decoder.depth_regressor.0", feature)))
    weights = (logits - logits.amax(1, keepdim=True)).exp()
    weights = weights / weights.sum(1, keepdim=True)
    span = math.log(c.depth_max) - math.log(c.depth_min)
    bins = [c.depth_min * math.exp(span * i / (c.num_depth_bins - 1)) for i in range(c.num_depth_bins)]
    depth = sum(weights[:, i : i + 1] * value for i, value in enumerate(bins)).clamp(c.depth_min, c.depth_max)
    normal = conv3(w, "decoder.normal_predictor.0", feature)
    for index in (2, 4, 6):
        normal = conv(w, f"decoder.normal_predictor.{index}", relu(normal))
    state = torch.cat([(depth - c.depth_max) / c.regress_scale, depth_logit, unit(normal, normal_logit)], dim=1)

    def channel_norm(name, x):
        return layer_norm(w, name, x.movedim(1, -1), 1e-5).movedim(-1, 1)

    def branch(name, x):
        q = f"{name}.0"
        y = relu(channel_norm(f"{q}.norm1", conv3(w, f"{q}.conv1", x)))
        y = relu(channel_norm(f"{q}.norm2", conv3(w, f"{q}.conv2", y)))
        if x.shape[1] != y.shape[1]:
            x = channel_norm(f"{q}.norm3", conv(w, f"{q}.downsample.0", x))
        return conv3(w, f"{name}.1", relu(x + y))

    net, gates = [], []
    for scale, (name, x) in enumerate((("04", read_0), ("08", relu(read_1)), ("16", relu(read_2)))):
        q = f"decoder.context_feature_encoder.outputs{name}"
        net.append(torch.tanh(branch(f"{q}.0", x)))
        gates.append(conv3(w, f"decoder.context_zqr_convs.{scale}", relu(branch(f"{q}.1", x))).tensor_split(3, dim=1))

    def gru(name, h, gate, *inputs):
        q = f"decoder.update_block.{name}"
        x = torch.cat(inputs, dim=1)
        z = torch.sigmoid(conv3(w, f"{q}.convz", torch.cat([h, x], 1)) + gate[0])
        r = torch.sigmoid(conv3(w, f"{q}.convr", torch.cat([h, x], 1)) + gate[1])
        new = torch.tanh(conv3(w, f"{q}.convq", torch.cat([r * h, x], 1)) + gate[2])
        return (1 - z) * h + z * new

    def pool(x):
        total = sum(
            pad(x, (1, 1, 1, 1))[:, :, i : i + x.shape[2], j : j + x.shape[3]] for i in range(3) for j in range(3)
        )
        return total[:, :, ::2, ::2] / 9

    def fit(x, like):
        return along_axes(x, *(corners(a, b) for a, b in zip(x.shape[2:], like.shape[2:], strict=True)))

    def reading(state):
        depth = (c.regress_scale * state[:, 0] + c.depth_max).clamp(c.depth_min, c.depth_max)
        return depth[0], state[0, 1], unit(state[:, 2:5], state[:, 5:])[0]

    results = [reading(along_axes(state, *(corners(n, 4 * n) for n in state.shape[2:])))]
    for _ in range(c.iters):
        for last in ("gru32", "gru16", "gru08") if c.slow_fast_gru else ("gru08",):
            net[2] = gru("gru32", net[2], gates[2], pool(net[1]))
            if last != "gru32":
                net[1] = gru("gru16", net[1], gates[1], fit(pool(net[0]), net[1]), fit(net[2], net[1]))
            if last == "gru08":
                net[0] = gru("gru08", net[0], gates[0], state, fit(net[1], net[0]))
        q = "decoder.update_block.flow_head"
        depth_change = conv3(w, f"{q}.conv2d", relu(conv3(w, f"{q}.conv1d", net[0])))
        normal_change = conv3(w, f"{q}.conv2n", relu(conv3(w, f"{q}.conv1n", net[0])))
        state = state + torch.cat([depth_change, normal_change], dim=1)
        results.append(reading(_convex(w, net[0], state)))
    return results


def _convex(w, net, state):
    """Every pixel of the four times larger state, one by one of its sixteen places in a coarse pixel."""
    mask = 0.25 * conv(w, "decoder.update_block.mask.2", relu(conv3(w, "decoder.update_block.mask.0", net)))
    _, _, height, width = state.shape
    around = pad(state, (1, 1, 1, 1))
    fine = torch.zeros(1, 6, 4 * height, 4 * width, dtype=state.dtype)
    for row in range(4):
        for column in range(4):
            weights = torch.stack([mask[:, 16 * n + 4 * row + column] for n in range(9)]).exp()
            weights = weights / weights.sum(0)
            fine[:, :, row::4, column::4] = sum(
                weights[3 * i + j] * around[:, :, i : i + height, j : j + width] for i in range(3) for j in range(3)
            )
    return fine


def _metric3d_tokens(w, c, image, grid):
    """The four token sets that the decoder reads."""
    side = c.pos_image_size // c.patch_size
    table = w["encoder.pos_embed"][0, 1:]
    if grid != [side, side]:
        offset = c.pos_interpolate_offset
        rows, columns = (cubic_scaled(side, n, side / (n + offset)) for n in grid)
        table = along_axes(table.T.reshape(-1, side, side), rows, columns).flatten(1).T
    x = vit_tokens(w, "encoder", image, c.patch_size, table, c.num_register_tokens)
    features, swiglu = [], "encoder.blocks.0.0.mlp.w12.weight" in w
    for index in range(c.depth):
        x = block(w, f"encoder.blocks.0.{index}", x, c.num_heads, c.vit_layer_norm_eps, swiglu=swiglu)
        if c.variant == "giant2" and (index + 1) in [c.depth * k // 4 for k in (1, 2, 3, 4)]:
            features.append(x)
    return features or [layer_norm(w, "encoder.norm", x, c.vit_layer_norm_eps)] * 4
