"""A small policy, a bundle and a simulated robot for the tests of the deployment."""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from wbm.deploy.bundle import write_bundle
from wbm.deploy.config import DeployConfig
from wbm.deploy.contract import make_contract
from wbm.deploy.driver import Command, DriverInfo, Reading
from wbm.deploy.instructions import InstructionCache
from wbm.robot import joints
from wbm.robot.model import load_robot
from wbm.robot.schema import NUM_PROPRIO, PolicySchema

SCHEMA = PolicySchema(num_depth_points=32, num_lidar_points=16, text_dim=8)
SENTENCES = ("pick up the red mug", "pick up the tall blue bottle")


def weights(seed: int = 0) -> dict[str, np.ndarray]:
    """One matrix [width, 32] a field: the synthetic policy is tanh of a sum of linear maps."""
    rng = np.random.default_rng(seed)
    return {
        f.name: (rng.normal(size=(int(np.prod(f.shape)), 32)) * (1e-4 if f.name == "depth_rgb" else 0.02)).astype(
            np.float32
        )
        for f in SCHEMA.observation
    }


def forward(observation: dict[str, np.ndarray], maps: dict[str, np.ndarray]) -> np.ndarray:
    """The synthetic policy in float64."""
    total = sum(observation[k].reshape(len(observation[k]), -1).astype(np.float64) @ maps[k] for k in maps)
    return np.tanh(total)


def onnx_model(maps: dict[str, np.ndarray], gain: float = 1.0) -> bytes:
    """The same policy as an ONNX model."""
    nodes, inputs, constants, terms = [], [], [], []
    for f in SCHEMA.observation:
        kind = TensorProto.UINT8 if f.dtype == "uint8" else TensorProto.FLOAT
        inputs.append(helper.make_tensor_value_info(f.name, kind, ["batch", *f.shape]))
        constants.append(numpy_helper.from_array(maps[f.name], f"w_{f.name}"))
        nodes += [
            helper.make_node("Cast", [f.name], [f"{f.name}_f"], to=TensorProto.FLOAT),
            helper.make_node("Flatten", [f"{f.name}_f"], [f"{f.name}_v"], axis=1),
            helper.make_node("MatMul", [f"{f.name}_v", f"w_{f.name}"], [f"{f.name}_y"]),
        ]
        terms.append(f"{f.name}_y")
    constants.append(numpy_helper.from_array(np.array(gain, dtype=np.float32), "gain"))
    nodes += [
        helper.make_node("Sum", terms, ["total"]),
        helper.make_node("Tanh", ["total"], ["squashed"]),
        helper.make_node("Mul", ["squashed", "gain"], ["action"]),
    ]
    output = helper.make_tensor_value_info("action", TensorProto.FLOAT, ["batch", 32])
    graph = helper.make_graph(nodes, "policy", inputs, [output], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.checker.check_model(model)
    return model.SerializeToString()


def random_observation(count: int, seed: int = 1) -> dict[str, np.ndarray]:
    """Observations [count, ...] that fit the schema."""
    rng = np.random.default_rng(seed)
    result = {}
    for f in SCHEMA.observation:
        shape = (count, *f.shape)
        if f.dtype == "uint8":
            result[f.name] = rng.integers(0, 256 if f.name == "depth_rgb" else 2, shape, dtype=np.uint8)
        else:
            result[f.name] = rng.normal(size=shape).astype(np.float32)
    return result


def make_bundle(path, seed: int = 0, gain: float = 1.0, cfg: DeployConfig | None = None, **overrides):
    """Write a synthetic bundle and return its path."""
    cfg = cfg or DeployConfig()
    maps, inputs = weights(seed), random_observation(cfg.num_golden)
    rng = np.random.default_rng(7)
    arguments = {
        "onnx": onnx_model(maps, gain),
        "contract": make_contract(
            load_robot(), SCHEMA, cfg, "synthetic", {"proprio": (np.zeros(NUM_PROPRIO), np.ones(NUM_PROPRIO))}
        ),
        "golden_inputs": inputs,
        "golden_action": forward(inputs, maps),
        "instructions": InstructionCache({s: rng.normal(size=8) for s in SENTENCES}, 8),
        "provenance": {"student": "student/synthetic/0", "commit": "none"},
    }
    return write_bundle(path, **(arguments | overrides))


class FakeRobot:
    """A robot that follows its targets exactly, on a clock of its own, with points around it."""

    def __init__(self, seed: int = 0) -> None:
        robot = load_robot()
        self.q, self.qd = robot.q_home.copy(), np.zeros(32)
        self.time, self.dt = 10.0, 0.04
        self.rng = np.random.default_rng(seed)
        self.commands: list[Command] = []
        self.holds: list[str] = []

    @property
    def info(self) -> DriverInfo:
        return DriverInfo(joints.JOINT_NAMES)

    def now(self) -> float:
        return self.time

    def read(self) -> Reading:
        self.time += self.dt
        p, m = SCHEMA.num_depth_points, SCHEMA.num_lidar_points
        return Reading(
            stamps={"joints": self.time - 0.002, "depth": self.time - 0.03, "lidar": self.time - 0.05},
            joint_names=joints.JOINT_NAMES,
            q=self.q.copy(),
            qd=self.qd.copy(),
            depth_xyz=(self.rng.normal(size=(p, 3)) * 0.2 + [0, 0, 0.8]).astype(np.float32),
            depth_rgb=self.rng.integers(0, 256, (p, 3), dtype=np.uint8),
            depth_valid=np.ones(p, dtype=np.uint8),
            depth_target=np.zeros(p, dtype=np.uint8),
            lidar_xyz=(self.rng.normal(size=(m, 3)) + np.array([2.0, 0, 0])).astype(np.float32),
            lidar_valid=np.ones(m, dtype=np.uint8),
        )

    def command(self, command: Command) -> None:
        self.commands.append(command)
        self.qd = (command.q_target - self.q) / self.dt
        self.q = command.q_target.copy()

    def hold(self, reason: str) -> None:
        self.holds.append(reason)
        self.qd = np.zeros(32)
