"""Equation (8), weighted by phase and group, with the losses of the auxiliary heads."""

from __future__ import annotations

import torch
from torch import Tensor

from wbm.learning.student_config import DistillConfig
from wbm.robot import joints


def distill_loss(
    out: dict[str, Tensor], batch: dict[str, Tensor], cfg: DistillConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """L = sum_g w_g(d) smooth_l1(pi_g(o) - a_g*) + min(w_p |p - p_obj|^2, cap) + w_m BCE(target mask).

    Equation (8) with smooth L1 (beta `cfg.beta`) in place of the square, over the groups g = base, arm, hand, neck,
    each the mean over its joints. w is 1 for the base, `cfg.neck_weight` for the neck, and for arm and hand
    1 + gain * sigmoid((distance - d) / width) with d the distance from grasp frame to object. Where the cap of the
    position term is reached, the error beyond it [m] is added: a constant has no gradient, and a head that starts far
    off would never return.

    Args:
        out: of `Student.forward`.
        batch: of `EpisodeDataset`, as tensors.
        cfg: weights.

    Returns:
        The loss, and detached scalars: "base", "arm", "hand", "neck" (unweighted), "p_obj_m" (median error in metres),
        "mask_bce", "loss".
    """
    error = torch.nn.functional.smooth_l1_loss(out["action"], batch["action"], beta=cfg.beta, reduction="none")
    valid = batch["action_valid"]  # [B,k]
    near = 1.0 + cfg.contact_gain * torch.sigmoid((cfg.contact_distance - batch["ee_distance"]) / cfg.contact_width)
    weight = {"base": 1.0, "arm": near[:, None], "hand": near[:, None], "neck": cfg.neck_weight}
    count = valid.sum()
    total = error.new_zeros(())
    report: dict[str, Tensor] = {}
    for name, group in joints.GROUPS.items():
        per_step = error[..., group].mean(-1) * valid
        total = total + (weight[name] * per_step).sum() / count
        report[name] = per_step.detach().sum() / count
    square = ((out["p_obj_b"] - batch["p_obj_b"]) ** 2).sum(-1)
    far = (square + 1e-12).sqrt() - (cfg.p_obj_cap / cfg.p_obj_weight) ** 0.5 if cfg.p_obj_weight else square
    total = total + ((cfg.p_obj_weight * square).clamp(max=cfg.p_obj_cap) + far.clamp(min=0.0)).mean()
    seen = batch["depth_valid"].to(error.dtype)
    bce = torch.nn.functional.binary_cross_entropy_with_logits(
        out["target_logit"], batch["target_label"].to(error.dtype), reduction="none"
    )
    mask = (bce * seen).sum() / seen.sum().clamp(min=1.0)
    total = total + cfg.mask_weight * mask
    report["p_obj_m"] = square.detach().sqrt().median()
    report["mask_bce"] = mask.detach()
    report["loss"] = total.detach()
    return total, report
