"""The policy's interface: every observation and action field with shape, unit, frame and scale (NumPy only).

One object serves training, the dataset, the exported bundle and the robot, so a permuted joint or a wrong unit can be
refused by name. Fields are listed in the order in which they are concatenated.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from wbm.robot import joints

SCHEMA_VERSION = 1
POLICY_RATE_HZ = 25.0


@dataclass(frozen=True)
class Field:
    """One array of the interface.

    Attributes:
        name: key in dictionaries, datasets and ONNX inputs.
        shape: per environment and step.
        dtype: NumPy name as stored and exchanged.
        unit: SI unit of the values ("1" for none).
        frame: the frame that the values are expressed in, or "-".
        description: what a robot programmer must supply.
        labels: names of the entries along the last axis, when they differ.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str
    unit: str
    frame: str
    description: str
    labels: tuple[str, ...] = ()


@dataclass(frozen=True)
class ActionSpec:
    """Joint targets as scaled increments: `q_target = q + scale * action`, base increments in the base frame.

    Attributes:
        joint_names: order of the 32 values.
        scale: metres or radians that an action of 1 means, [32].
        limit: actions are clipped to +-limit before scaling.
    """

    joint_names: tuple[str, ...] = joints.JOINT_NAMES
    scale: tuple[float, ...] = field(default_factory=lambda: (0.06,) * 3 + (0.12,) * 7 + (0.3,) * 16 + (0.06,) * 6)
    limit: float = 3.0

    @property
    def size(self) -> int:
        """Number of action values."""
        return len(self.joint_names)


def _names(prefix: str, count: int) -> tuple[str, ...]:
    return tuple(f"{prefix}{i}" for i in range(count))


_BODY = joints.JOINT_NAMES[3:]
_BASE_TWIST = ("base_vx", "base_vy", "base_wz")

PROPRIO_LABELS: tuple[str, ...] = (
    tuple(f"q/{n}" for n in _BODY)  # 29: arm, hand, neck positions (the base's pose in the world is not observed)
    + tuple(f"qd/{n}" for n in _BASE_TWIST)  # 3: base twist in the base frame
    + tuple(f"qd/{n}" for n in _BODY)  # 29
    + tuple(f"ee_pos_b/{a}" for a in "xyz")
    + tuple(f"ee_rot6d_b/{i}" for i in range(6))
    + tuple(f"camera_pos_b/{a}" for a in "xyz")
    + tuple(f"camera_rot6d_b/{i}" for i in range(6))
    + tuple(f"tip_{f}_pos_e/{a}" for f in joints.FINGERS for a in "xyz")  # 12, in the grasp frame
)
NUM_PROPRIO = len(PROPRIO_LABELS)


@dataclass(frozen=True)
class PolicySchema:
    """Observation fields, action, rate and delays of a whole-body policy.

    Attributes:
        num_depth_points: points taken from the depth camera.
        num_lidar_points: points taken from the LiDAR.
        text_dim: width of the instruction embedding.
    """

    num_depth_points: int = 256
    num_lidar_points: int = 128
    text_dim: int = 384
    action: ActionSpec = field(default_factory=ActionSpec)
    rate_hz: float = POLICY_RATE_HZ
    version: int = SCHEMA_VERSION

    @property
    def observation(self) -> tuple[Field, ...]:
        """Fields of one observation, in order."""
        p, m = self.num_depth_points, self.num_lidar_points
        return (
            Field("depth_xyz", (p, 3), "float32", "m", "base", "points of the depth camera; zeros where not valid"),
            Field("depth_rgb", (p, 3), "uint8", "1", "-", "colour of each depth point, 0 to 255"),
            Field("depth_valid", (p,), "uint8", "1", "-", "1 where the depth point is a return"),
            Field(
                "depth_target",
                (p,),
                "uint8",
                "1",
                "-",
                "1 where a segmenter marks the target; all 0 when there is none",
            ),
            Field("lidar_xyz", (m, 3), "float32", "m", "base", "points of the LiDAR; zeros where not valid"),
            Field("lidar_valid", (m,), "uint8", "1", "-", "1 where the LiDAR point is a return"),
            Field(
                "proprio",
                (NUM_PROPRIO,),
                "float32",
                "m, rad, 1/s",
                "base",
                "joint state and forward kinematics",
                PROPRIO_LABELS,
            ),
            Field(
                "prev_action",
                (self.action.size,),
                "float32",
                "1",
                "-",
                "the action of the step before",
                joints.JOINT_NAMES,
            ),
            Field(
                "text",
                (self.text_dim,),
                "float32",
                "1",
                "-",
                "sentence embedding of the instruction; zeros when there is none",
            ),
        )

    def field_named(self, name: str) -> Field:
        """The observation field called `name`.

        Raises:
            KeyError: no such field.
        """
        for item in self.observation:
            if item.name == name:
                return item
        raise KeyError(f"observation has no field {name!r}; fields are {[f.name for f in self.observation]}")

    def check(self, observation: dict[str, np.ndarray]) -> None:
        """Check names, shapes (after one batch axis) and finiteness of an observation.

        Raises:
            ValueError: names the first field that is missing, unknown, misshapen or not finite.
        """
        expected = {f.name: f for f in self.observation}
        for name in observation:
            if name not in expected:
                raise ValueError(f"observation field {name!r} is not in the schema; expected {sorted(expected)}")
        for name, item in expected.items():
            if name not in observation:
                raise ValueError(f"observation field {name!r} is missing")
            array = observation[name]
            if array.shape[1:] != item.shape:
                raise ValueError(f"observation field {name!r} has shape {array.shape[1:]}, expected {item.shape}")
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise ValueError(f"observation field {name!r} holds values that are not finite")

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready description, complete enough to rebuild the schema and for a person to read."""
        return {
            "version": self.version,
            "rate_hz": self.rate_hz,
            "num_depth_points": self.num_depth_points,
            "num_lidar_points": self.num_lidar_points,
            "text_dim": self.text_dim,
            "action": asdict(self.action),
            "observation": [asdict(f) for f in self.observation],
        }

    @staticmethod
    def from_dict(data: dict[str, Any]) -> PolicySchema:
        """Rebuild a schema from `to_dict`'s answer.

        Raises:
            ValueError: written by another schema version, or its fields differ from this version's.
        """
        if data.get("version") != SCHEMA_VERSION:
            raise ValueError(f"policy schema version {data.get('version')} cannot be read by version {SCHEMA_VERSION}")
        action = ActionSpec(
            tuple(data["action"]["joint_names"]), tuple(data["action"]["scale"]), float(data["action"]["limit"])
        )
        schema = PolicySchema(
            data["num_depth_points"], data["num_lidar_points"], data["text_dim"], action, data["rate_hz"]
        )
        if [f["name"] for f in data["observation"]] != [f.name for f in schema.observation]:
            raise ValueError("policy schema lists other observation fields than this version")
        return schema

    def with_points(self, depth: int, lidar: int) -> PolicySchema:
        """The same schema with other cloud sizes."""
        return replace(self, num_depth_points=depth, num_lidar_points=lidar)


def to_increment(xp: Any, q: Any, q_target: Any, spec: ActionSpec) -> Any:
    """Action [...,32] that moves `q` [...,32] to `q_target`: the inverse of `to_target`, clipped to the limit.

    Args:
        xp: numpy or torch.
        q, q_target: measured joints and joint targets, m or rad, of the same dtype.
        spec: scale and limit of the action.
    """
    delta = q_target - q
    c, s = xp.cos(q[..., 2]), xp.sin(q[..., 2])
    x, y = delta[..., 0], delta[..., 1]
    delta_b = xp.concatenate([xp.stack([c * x + s * y, c * y - s * x], -1), delta[..., 2:]], -1)
    return xp.clip(delta_b / _scale(xp, q, spec), -spec.limit, spec.limit)


def to_target(xp: Any, q: Any, action: Any, spec: ActionSpec) -> Any:
    """Joint targets [...,32] of an action [...,32] at joint positions `q` [...,32]; base increments are in B.

    Args:
        xp: numpy or torch.
        q, action: of the same dtype; the action is clipped to the limit.
        spec: scale and limit of the action.
    """
    delta_b = xp.clip(action, -spec.limit, spec.limit) * _scale(xp, q, spec)
    c, s = xp.cos(q[..., 2]), xp.sin(q[..., 2])
    x, y = delta_b[..., 0], delta_b[..., 1]
    return q + xp.concatenate([xp.stack([c * x - s * y, s * x + c * y], -1), delta_b[..., 2:]], -1)


def _scale(xp: Any, like: Any, spec: ActionSpec) -> Any:
    return xp.asarray(spec.scale, dtype=like.dtype, device=like.device)
