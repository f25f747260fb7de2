"""From one observation to tokens: PointNet-style encoders of clouds, and what the instruction picks out of them.

All inputs are the fields of the policy schema in SI units; normalisation happens here, with buffers that travel with
the weights. An invalid point never reaches a pooled value: clouds may be empty.
"""

# torch types registered buffers as Tensor | Module.
# pyright: reportOperatorIssue=false

from __future__ import annotations

import torch
from torch import Tensor, nn

from wbm.learning.student_config import StudentConfig
from wbm.robot.schema import PROPRIO_LABELS, PolicySchema

_FAR = -1e4  # a logit that softmax turns into 0 without infinities
_EE_POS = PROPRIO_LABELS.index("ee_pos_b/x")
_EE_ROT = PROPRIO_LABELS.index("ee_rot6d_b/0")
_CAMERA_POS = PROPRIO_LABELS.index("camera_pos_b/x")
_CAMERA_ROT = PROPRIO_LABELS.index("camera_rot6d_b/0")
_VELOCITIES = [label.startswith("qd/") for label in PROPRIO_LABELS]
_LOCAL_CHANNELS = 13
_SPREAD, _EXTENT, _OBJECT = 0.03, 0.06, 0.1
"""Metres that count as 1 in the target's spread and extent, and in coordinates about its centroid."""


def rotation_from_6d(columns: Tensor) -> Tensor:
    """Rotation matrices [...,3,3] whose first two columns are given as [...,6] (already orthonormal)."""
    a, b = columns[..., :3], columns[..., 3:]
    c = torch.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        dim=-1,
    )
    return torch.stack([a, b, c], dim=-1)


def masked_max(features: Tensor, weight: Tensor) -> Tensor:
    """Maximum over points [B,P,C] where weight [B,P,1] is 1; features must not be negative, so that none gives 0."""
    return (features * weight).max(dim=1).values  # the backward pass of max with indices is far cheaper than amax's


def masked_softmax(logits: Tensor, valid: Tensor) -> Tensor:
    """Softmax over the points [B,P,K] that are valid [B,P,1]; all zeros where none is."""
    return torch.softmax(torch.where(valid > 0, logits, _FAR), dim=1) * valid


def products(v: Tensor) -> Tensor:
    """xx, yy, zz, xy, xz and yz [...,6] of vectors [...,3]."""
    x, y, z = v.unbind(-1)
    return torch.stack([x * x, y * y, z * z, x * y, x * z, y * z], dim=-1)


def local_shape(xyz: Tensor, rgb: Tensor, valid: Tensor, radius: float) -> Tensor:
    """What surrounds each point within `radius` metres: density, mean offset, covariance and mean colour.

    Args:
        xyz: [B,P,3] metres.
        rgb: [B,P,3] about -1 to 1.
        valid: [B,P,1].
        radius: metres; a neighbour's weight is 1 - (d / radius)^2.

    Returns:
        [B,P,13], offsets and covariances in units of the radius.
    """
    # second moments cancel where the origin is far: take it amid the points
    centre = (xyz * valid).sum(1, keepdim=True) / valid.sum(1, keepdim=True).clamp(min=1.0)
    scaled = (xyz - centre) / radius
    square = (scaled * scaled).sum(-1, keepdim=True)
    one = torch.ones_like(square)
    # 1 - |a - b|^2 as a single product: a pass over [B,P,P] costs more than the arithmetic in it
    left = torch.cat([2.0 * scaled, 1.0 - square, -one], dim=-1)
    right = torch.cat([scaled, one, square], dim=-1)
    weight = torch.relu(left @ right.transpose(1, 2))
    sums = weight @ (torch.cat([one, scaled, products(scaled), rgb], dim=-1) * valid)
    count = sums[..., :1]
    mean = sums[..., 1:] / count.clamp(min=0.5)  # a valid point counts itself
    outer = products(mean[..., :3])
    return torch.cat([0.1 * count, mean[..., :3] - scaled, mean[..., 3:9] - outer, mean[..., 9:]], dim=-1) * valid


class PointEncoder(nn.Module):
    """A shared two-layer perceptron on points; the instruction scales and shifts its hidden layer (FiLM)."""

    def __init__(self, inputs: int, hidden: int, outputs: int, text_width: int = 0) -> None:
        super().__init__()
        self.first = nn.Linear(inputs, hidden)
        self.film = nn.Linear(text_width, 2 * hidden) if text_width else None
        self.second = nn.Linear(hidden, outputs)

    def forward(self, points: Tensor, text: Tensor | None = None) -> Tensor:
        """Features [B,P,outputs], not negative, of points [B,P,inputs] given text [B,text_width]."""
        hidden = torch.relu(self.first(points))
        if self.film is not None and text is not None:
            gain, shift = self.film(text).unsqueeze(1).chunk(2, dim=-1)
            hidden = torch.relu(hidden * (1.0 + gain) + shift)
        return torch.relu(self.second(hidden))


class Tokenizer(nn.Module):
    """Tokens of an observation, and which points belong to the target.

    The target is given by a mask, by the instruction, or by both. Each depth point gets a logit of belonging to the
    target from its position, colour, surroundings, the mask and (FiLM) the instruction; the points that it selects
    give the target's token and its centroid, so that the network has a target where no mask is given.

    How the target lies (which way a hand must turn to close across its narrow side) is a matter of centimetres that is
    lost among coordinates of metres: second moments and extents of its points in the grasp frame, and an encoder of
    the points about their centroid, say it.
    """

    def __init__(self, schema: PolicySchema, cfg: StudentConfig) -> None:
        super().__init__()
        self.cfg = cfg
        width = cfg.width
        num_proprio = schema.field_named("proprio").shape[0]
        self.register_buffer("proprio_mean", torch.zeros(num_proprio))
        self.register_buffer("proprio_std", torch.ones(num_proprio))
        self.register_buffer("prev_action_std", torch.ones(schema.action.size))
        self.register_buffer("centre_b", torch.zeros(3))
        known = ~torch.tensor(_VELOCITIES) | cfg.use_velocity
        self.register_buffer("known", known.float(), persistent=False)
        self.text_gain = float(schema.text_dim) ** 0.5
        self.text = nn.Linear(schema.text_dim, width)
        channels = 3 + 3 + 3 + 1 + (_LOCAL_CHANNELS if cfg.local_radius else 0)
        self.depth = PointEncoder(channels, cfg.point_width, cfg.point_width, text_width=width)
        self.select = nn.Linear(cfg.point_width, 1 + cfg.attention_tokens)
        self.pooled = nn.Linear(cfg.point_width, width)
        self.attended = nn.Linear(cfg.point_width, width)
        if cfg.lidar_tokens:
            self.lidar = PointEncoder(6, cfg.point_width, cfg.point_width)
            self.scan = nn.Linear(cfg.point_width, width * cfg.lidar_tokens)
        self.target = nn.Sequential(nn.Linear(29, width), nn.ReLU(), nn.Linear(width, width))
        self.shape = PointEncoder(7, cfg.point_width, cfg.point_width)
        self.shaped = nn.Linear(cfg.point_width, width)
        self.proprio = nn.Linear(num_proprio, width * cfg.proprio_tokens)
        self.prev_action = nn.Linear(schema.action.size, width) if cfg.use_prev_action else None
        self.num_tokens = 6 + cfg.attention_tokens + cfg.lidar_tokens + cfg.proprio_tokens + cfg.use_prev_action
        self.kind = nn.Parameter(0.02 * torch.randn(self.num_tokens, width))

    def forward(self, obs: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Tokens [B,K,width], target logits [B,P], and the selected points' centroid [B,3] in the base frame."""
        proprio = obs["proprio"]
        ee_pos = proprio[:, _EE_POS : _EE_POS + 3].unsqueeze(1)
        ee_rot = rotation_from_6d(proprio[:, _EE_ROT : _EE_ROT + 6])
        text = self.text(obs["text"] * (self.text_gain if self.cfg.use_text else 0.0))

        xyz = obs["depth_xyz"]
        valid = obs["depth_valid"].to(xyz.dtype).unsqueeze(-1)
        mask = obs["depth_target"].to(xyz.dtype).unsqueeze(-1) * valid * float(self.cfg.use_mask)
        rgb = obs["depth_rgb"].to(xyz.dtype) * (2.0 / 255.0) - 1.0
        in_ee = ((xyz - ee_pos) @ ee_rot) * valid
        parts = [(xyz - self.centre_b) * valid, in_ee, rgb * valid, mask]
        if self.cfg.local_radius:
            parts.append(local_shape(xyz, rgb, valid, self.cfg.local_radius))
        features = self.depth(torch.cat(parts, dim=-1), text)
        logits = self.select(features)
        weights = masked_softmax(logits, valid)  # [B,P,1+A]: the first selects the target
        attended = weights.transpose(1, 2) @ features
        given = masked_max(features, mask)
        rest = masked_max(features, valid - mask)
        tokens = [self.pooled(torch.stack([given, rest], dim=1)), self.attended(attended)]

        selected = (weights[..., :1] * xyz).sum(1)
        any_valid = valid.amax(1)
        selected_ee = ((selected.unsqueeze(1) - ee_pos) @ ee_rot).squeeze(1) * any_valid
        count = mask.sum(1)
        masked = (mask * xyz).sum(1) / count.clamp(min=1.0)
        has_mask = count.clamp(max=1.0)
        masked_ee = ((masked.unsqueeze(1) - ee_pos) @ ee_rot).squeeze(1) * has_mask
        spread = (weights[..., :1] * (xyz - selected.unsqueeze(1)) ** 2).sum((1, 2)).unsqueeze(-1)
        target = [selected - self.centre_b * any_valid, selected_ee, masked - self.centre_b * has_mask, masked_ee]
        # The target's points: those of the mask or, without one, those that are selected.
        picked = weights[..., :1] / weights[..., :1].amax(1, keepdim=True).clamp(min=1e-6)
        on_target = torch.where(has_mask.unsqueeze(1) > 0, mask, picked * valid)
        centre = torch.where(has_mask > 0, masked, selected)
        # Where the camera has it: what the neck is to mend.
        camera_rot = rotation_from_6d(proprio[:, _CAMERA_ROT : _CAMERA_ROT + 6])
        from_camera = (centre - proprio[:, _CAMERA_POS : _CAMERA_POS + 3]).unsqueeze(1) @ camera_rot
        sight = from_camera.squeeze(1) / from_camera.norm(dim=-1).clamp(min=0.05) * any_valid
        about_b = xyz - centre.unsqueeze(1)
        about_ee = about_b @ ee_rot
        moments = products(about_ee / _SPREAD).clamp(-9.0, 9.0)
        moments = (on_target * moments).sum(1) / on_target.sum(1).clamp(min=1.0)
        sides = torch.cat([about_ee, -about_ee], dim=-1).clamp(-0.15, 0.15) / _EXTENT
        extent = (on_target * sides).max(dim=1).values
        target = torch.cat([*target, has_mask, 10.0 * spread, 3.0 * sight, moments, extent], dim=-1)
        shape = torch.cat([about_ee / _OBJECT, about_b / _OBJECT, on_target], dim=-1).clamp(-3.0, 3.0)
        shape = self.shaped(masked_max(self.shape(shape * valid), on_target))
        tokens.append(torch.stack([self.target(target), text, shape], dim=1))

        if self.cfg.lidar_tokens:
            scan = obs["lidar_xyz"]
            scan_valid = obs["lidar_valid"].to(scan.dtype).unsqueeze(-1)
            scan_ee = ((scan - ee_pos) @ ee_rot) * scan_valid
            points = self.lidar(torch.cat([scan * scan_valid, scan_ee], dim=-1))
            tokens.append(self.scan(masked_max(points, scan_valid)).unflatten(1, (self.cfg.lidar_tokens, -1)))
        state = (proprio - self.proprio_mean) / self.proprio_std * self.known
        tokens.append(self.proprio(state).unflatten(1, (self.cfg.proprio_tokens, -1)))
        if self.prev_action is not None:
            tokens.append(self.prev_action(obs["prev_action"] / self.prev_action_std).unsqueeze(1))
        return torch.cat(tokens, dim=1) + self.kind, logits[..., 0], selected
