"""The contract: everything that a robot must agree with before a policy may move it, as one typed JSON document."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from wbm.deploy.config import DeployConfig
from wbm.deploy.faults import BundleError, Fault
from wbm.deploy.validate import validate
from wbm.robot import joints
from wbm.robot.schema import PolicySchema

if TYPE_CHECKING:
    from wbm.robot.model import RobotModel

FORMAT_VERSION = 1
UNITS = {"length": "m", "angle": "rad", "time": "s", "quaternion": "w x y z", "colour": "0 to 255"}

_POSITIVE = {"type": "number", "exclusiveMinimum": 0}
_NOT_NEGATIVE = {"type": "number", "minimum": 0}
_TEXT = {"type": "string"}


def _numbers(count: int) -> dict[str, Any]:
    return {"type": "array", "items": {"type": "number"}, "minItems": count, "maxItems": count}


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": sorted(properties), "additionalProperties": False}


_N = joints.NUM_JOINTS
_FIELD = _object(
    {
        "name": {"type": "string", "minLength": 1},
        "shape": {"type": "array", "items": {"type": "integer", "minimum": 1, "maximum": 1 << 20}},
        "dtype": {"enum": ["float32", "uint8"]},
        "unit": _TEXT,
        "frame": _TEXT,
        "description": _TEXT,
        "labels": {"type": "array", "items": _TEXT},
    }
)
_LINK = _object(
    {
        "name": _TEXT,
        "parent": {"type": "integer", "minimum": -1, "maximum": 1023},
        "pos": _numbers(3),
        "quat": _numbers(4),
        "type": {"enum": ["fixed", "hinge", "slide"]},
        "axis": _numbers(3),
        "joint": {"type": "integer", "minimum": -1, "maximum": _N - 1},
    }
)
_FRAME = _object({"link": {"type": "integer", "minimum": 0, "maximum": 1023}, "pos": _numbers(3), "quat": _numbers(4)})
_MOMENTS = _object(
    {
        "mean": {"type": "array", "items": {"type": "number"}},
        "std": {"type": "array", "items": _POSITIVE},
        "applied": {"enum": ["inside policy.onnx"]},
    }
)

CONTRACT_SCHEMA: dict[str, Any] = _object(
    {
        "format_version": {"type": "integer", "const": FORMAT_VERSION},
        "name": {"type": "string", "minLength": 1},
        "units": {"const": UNITS},
        "policy": _object(
            {
                "version": {"type": "integer"},
                "rate_hz": _POSITIVE,
                "num_depth_points": {"type": "integer", "minimum": 1, "maximum": 65536},
                "num_lidar_points": {"type": "integer", "minimum": 1, "maximum": 65536},
                "text_dim": {"type": "integer", "minimum": 1, "maximum": 65536},
                "action": _object(
                    {
                        "joint_names": {"type": "array", "items": _TEXT, "minItems": _N, "maxItems": _N},
                        "scale": _numbers(_N),
                        "limit": _POSITIVE,
                    }
                ),
                "observation": {"type": "array", "items": _FIELD, "minItems": 1, "maxItems": 64},
            }
        ),
        "joints": _object(
            {
                "names": {"type": "array", "items": _TEXT, "minItems": _N, "maxItems": _N},
                "unit": {"type": "array", "items": {"enum": ["m", "rad"]}, "minItems": _N, "maxItems": _N},
                "q_min": _numbers(_N),
                "q_max": _numbers(_N),
                "qd_max": _numbers(_N),
                "qdd_max": _numbers(_N),
                "q_home": _numbers(_N),
            }
        ),
        "tree": {"type": "array", "items": _LINK, "minItems": 1, "maxItems": 1024},
        "frames": {"type": "object", "additionalProperties": _FRAME},
        "sensors": _object(
            {
                "camera": _object(
                    {"frame": {"const": "camera"}, "max_range_m": _POSITIVE, "min_range_m": _NOT_NEGATIVE}
                ),
                "lidar": _object({"frame": {"const": "lidar"}, "max_range_m": _POSITIVE, "min_range_m": _NOT_NEGATIVE}),
            }
        ),
        "delays": _object({"joints_s": _NOT_NEGATIVE, "depth_s": _NOT_NEGATIVE, "lidar_s": _NOT_NEGATIVE}),
        "max_age": _object({"joints_s": _POSITIVE, "depth_s": _POSITIVE, "lidar_s": _POSITIVE}),
        "tolerances": _object({"limit": _POSITIVE, "velocity_factor": _POSITIVE, "consistency": _POSITIVE}),
        "workspace": _object({"base_box_m": _POSITIVE, "floor_clearance_m": _NOT_NEGATIVE, "reach_m": _POSITIVE}),
        "normalisers": {"type": "object", "additionalProperties": _MOMENTS},
        "parity_tolerance": _POSITIVE,
    }
)


@dataclass(frozen=True)
class Contract:
    """A validated contract.

    Attributes:
        data: the JSON document, as `CONTRACT_SCHEMA` describes it.
        schema: the policy's observation and action fields.
        q_min, q_max, qd_max, qdd_max, q_home: limits and home pose [32], m or rad, and s.
    """

    data: dict[str, Any]
    schema: PolicySchema
    q_min: np.ndarray
    q_max: np.ndarray
    qd_max: np.ndarray
    qdd_max: np.ndarray
    q_home: np.ndarray

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint order of every array of 32."""
        return tuple(self.data["joints"]["names"])

    @property
    def dt(self) -> float:
        """Seconds between two policy steps."""
        return 1.0 / self.schema.rate_hz

    @staticmethod
    def from_dict(data: Any) -> Contract:
        """Validate a JSON document and make the contract.

        Raises:
            BundleError: `BUNDLE_VERSION` for another format, `CONTRACT` with the place that does not fit.
        """
        version = data.get("format_version") if isinstance(data, dict) else None
        if version != FORMAT_VERSION:
            raise BundleError(
                Fault.BUNDLE_VERSION, f"contract has format version {version}, this runtime reads {FORMAT_VERSION}"
            )
        try:
            validate(data, CONTRACT_SCHEMA)
            _check_meaning(data)
            schema = PolicySchema.from_dict(data["policy"])
            _check_fields(data, schema)
        except (ValueError, KeyError, TypeError) as error:
            raise BundleError(Fault.CONTRACT, str(error)) from error
        arrays = {
            k: np.array(data["joints"][k], dtype=np.float64) for k in ("q_min", "q_max", "qd_max", "qdd_max", "q_home")
        }
        return Contract(data, schema, **arrays)


def _check_meaning(data: dict[str, Any]) -> None:
    """What a JSON schema cannot say: sorted links, ordered limits, one joint order."""
    block = data["joints"]
    if block["names"] != data["policy"]["action"]["joint_names"] or len(set(block["names"])) != _N:
        raise ValueError("contract.joints.names must be 32 different names in the order of the action")
    for i, name in enumerate(block["names"]):
        if not block["q_min"][i] < block["q_max"][i]:
            raise ValueError(
                f"contract.joints: {name} has q_min {block['q_min'][i]} not below q_max {block['q_max'][i]}"
            )
        if not (block["qd_max"][i] > 0 and block["qdd_max"][i] > 0 and data["policy"]["action"]["scale"][i] > 0):
            raise ValueError(f"contract.joints: {name} needs positive velocity, acceleration and action scale")
    for i, link in enumerate(data["tree"]):
        if not link["parent"] < i or (link["parent"] == -1) != (i == 0):
            raise ValueError(f"contract.tree[{i}] ({link['name']}) must come after its parent; only link 0 has none")
        if (link["joint"] == -1) != (link["type"] == "fixed"):
            raise ValueError(f"contract.tree[{i}] ({link['name']}) has joint {link['joint']} but type {link['type']}")
    if sorted(link["joint"] for link in data["tree"] if link["joint"] >= 0) != list(range(_N)):
        raise ValueError("contract.tree must hold each of the 32 joints once")
    needed = {"ee", "camera", "lidar", "base", *(f"tip_{f}" for f in joints.FINGERS)}
    if not needed <= set(data["frames"]):
        raise ValueError(f"contract.frames lacks {sorted(needed - set(data['frames']))}")
    for name, frame in data["frames"].items():
        if frame["link"] >= len(data["tree"]):
            raise ValueError(f"contract.frames.{name} names link {frame['link']}, which the tree lacks")


def _check_fields(data: dict[str, Any], schema: PolicySchema) -> None:
    """Units, frames, shapes and labels of each field must be those of this version, not only its name."""
    for stored, field in zip(data["policy"]["observation"], schema.observation, strict=True):
        for key in ("shape", "labels"):
            if tuple(stored[key]) != getattr(field, key):
                raise ValueError(f"contract.policy.observation {field.name!r} has another {key} than this version")
        for key in ("dtype", "unit", "frame"):
            if stored[key] != getattr(field, key):
                raise ValueError(
                    f"contract.policy.observation {field.name!r} has {key} {stored[key]!r}, "
                    f"expected {getattr(field, key)!r}"
                )


def make_contract(
    robot: RobotModel,
    schema: PolicySchema,
    cfg: DeployConfig,
    name: str = "policy",
    normalisers: dict[str, tuple[np.ndarray, np.ndarray]] | None = None,
) -> Contract:
    """The contract of a policy that was trained on `robot`.

    Args:
        robot: limits, tree and frames.
        schema: observation and action fields.
        cfg: tolerances, delays and workspace.
        name: what the policy is called.
        normalisers: mean and standard deviation of a field as used inside the network, by field name.
    """
    kinds = ("fixed", "hinge", "slide")
    tree = [
        {
            "name": robot.link_names[i],
            "parent": int(robot.parent[i]),
            "pos": robot.link_pos[i].tolist(),
            "quat": robot.link_quat[i].tolist(),
            "type": kinds[int(robot.joint_type[i])],
            "axis": robot.joint_axis[i].tolist(),
            "joint": int(robot.joint_index[i]),
        }
        for i in range(len(robot.link_names))
    ]
    policy = schema.to_dict()
    policy["action"] = {k: list(v) if isinstance(v, tuple) else v for k, v in policy["action"].items()}
    policy["observation"] = [
        {**f, "shape": list(f["shape"]), "labels": list(f["labels"])} for f in policy["observation"]
    ]
    data = {
        "format_version": FORMAT_VERSION,
        "name": name,
        "units": UNITS,
        "policy": policy,
        "joints": {
            "names": list(robot.joint_names),
            "unit": ["m", "m"] + ["rad"] * (_N - 2),
            **{k: getattr(robot, k).tolist() for k in ("q_min", "q_max", "qd_max", "qdd_max", "q_home")},
        },
        "tree": tree,
        "frames": {
            k: {"link": int(f.link), "pos": f.pos.tolist(), "quat": f.quat.tolist()} for k, f in robot.frames.items()
        },
        "sensors": {
            "camera": {"frame": "camera", "max_range_m": cfg.range_camera_m, "min_range_m": cfg.range_min_m},
            "lidar": {"frame": "lidar", "max_range_m": cfg.range_lidar_m, "min_range_m": cfg.range_min_m},
        },
        "delays": {"joints_s": cfg.delay_joints_s, "depth_s": cfg.delay_cloud_s, "lidar_s": cfg.delay_cloud_s},
        "max_age": {"joints_s": cfg.max_age_joints_s, "depth_s": cfg.max_age_cloud_s, "lidar_s": cfg.max_age_cloud_s},
        "tolerances": {
            "limit": cfg.limit_tolerance,
            "velocity_factor": cfg.velocity_factor,
            "consistency": cfg.consistency,
        },
        "workspace": {"base_box_m": cfg.base_box_m, "floor_clearance_m": cfg.floor_clearance_m, "reach_m": cfg.reach_m},
        "normalisers": {
            k: {"mean": np.ravel(m).tolist(), "std": np.ravel(s).tolist(), "applied": "inside policy.onnx"}
            for k, (m, s) in (normalisers or {}).items()
        },
        "parity_tolerance": cfg.parity_tolerance,
    }
    return Contract.from_dict(data)
