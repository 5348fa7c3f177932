"""Several small networks fitted at once, each with held-out data for early stopping."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from datagen.train.inputs import F64, Bools, Ints

MEMBERS = 5
_WIDTH, _BATCH, _RATE, _DECAY = 32, 256, 3e-3, 1e-4
_MEAN = 0.995  # decay of the mean of weights over steps, which is validated and used
_EVERY = 50  # steps between validations on held-out rows
_PATIENCE = 1000  # steps without a lower held-out loss before the fit stops

Layer = tuple[F64, F64]  # weights (MEMBERS, in, out), bias (MEMBERS, 1, out)


def fit_networks(
    rows: F64, label: Bools, held_out: Ints, rng: np.random.Generator, steps: int
) -> tuple[Layer, ...]:
    """Layers of `MEMBERS` networks with one logit, of two hidden layers each, fitted to rows (N, F).

    Network k never learns from the rows whose `held_out` (N,) is k. Weights are exponential means over the
    steps, kept at the step with the lowest mean cross-entropy on held-out rows; at most `steps`.
    """
    import torch
    from torch.nn.functional import binary_cross_entropy_with_logits

    mean = rows.mean(0)
    # Features that hardly vary here must not be amplified.
    scale = np.maximum(rows.std(0), 1e-2)
    x = torch.from_numpy(((rows - mean) / scale).astype(np.float32))
    y = torch.from_numpy(label.astype(np.float32))
    learned = [np.flatnonzero(held_out != k) for k in range(MEMBERS)]
    judged = [torch.from_numpy(np.flatnonzero(held_out == k)) for k in range(MEMBERS)]
    now = [
        torch.from_numpy(rng.uniform(-1, 1, (MEMBERS, size, b)) / np.sqrt(a)).float().requires_grad_()
        for a, b in pairwise((rows.shape[1], _WIDTH, _WIDTH, 1))
        for size in (a, 1)
    ]
    averaged = [p.detach().clone() for p in now]
    kept, lowest, at = averaged, np.inf, 0

    def logits(x: torch.Tensor, parameters: list[torch.Tensor]) -> torch.Tensor:
        first, *others = (parameters[k : k + 2] for k in range(0, len(parameters), 2))
        hidden = torch.baddbmm(first[1], x, first[0])
        for weights, bias in others:
            hidden = torch.baddbmm(bias, torch.relu(hidden), weights)
        return hidden[..., 0]

    optimiser = torch.optim.AdamW(now, lr=_RATE, weight_decay=_DECAY)
    for step in range(1, steps + 1):
        chosen = torch.from_numpy(np.stack([rng.choice(some, _BATCH) for some in learned]))
        # The sum over networks: each has the gradient that it would have alone.
        loss = MEMBERS * binary_cross_entropy_with_logits(logits(x[chosen], now), y[chosen])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        with torch.no_grad():
            for smooth, p in zip(averaged, now, strict=True):
                smooth.lerp_(p, 1 - _MEAN)
            if step % _EVERY == 0 or step == steps:
                losses = [
                    binary_cross_entropy_with_logits(
                        logits(x[None, some], [p[k : k + 1] for p in averaged])[0], y[some]
                    )
                    for k, some in enumerate(judged)
                ]
                if (held := float(torch.stack(losses).mean())) < lowest:
                    kept, lowest, at = [p.clone() for p in averaged], held, step
                elif step - at >= _PATIENCE:
                    break
    arrays = [p.double().numpy() for p in kept]
    layers = [(arrays[k], arrays[k + 1]) for k in range(0, len(arrays), 2)]
    # The normalisation of features is folded into the first layer.
    weights = layers[0][0] / scale[:, None]
    layers[0] = weights, layers[0][1] - (mean @ weights)[:, None]
    return tuple(layers)
