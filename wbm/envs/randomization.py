"""Domain randomisation of an episode: each item has a range, a switch and one function that writes it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from wbm.envs.binding import SceneBinding
from wbm.envs.config import RandomizationConfig, Range
from wbm.envs.draws import Columns
from wbm.robot import joints
from wbm.sim.simulation import Simulation


class Randomizer:
    """Writes per-environment physics of an episode from its uniforms.

    Items that are switched off keep the scene record's and the robot's own values.
    """

    def __init__(self, cfg: RandomizationConfig, sim: Simulation, binding: SceneBinding, columns: Columns) -> None:
        self.cfg, self.sim, self.binding = cfg, sim, binding
        self.columns = {
            name: columns.add(name) for name in ("friction", "mass", "arm_gain", "hand_gain", "contact_time")
        }
        self._gain = torch.as_tensor(np.asarray(binding.model.actuator_gainprm))
        self._bias = torch.as_tensor(np.asarray(binding.model.actuator_biasprm))

    def load(self, ids: Tensor, scenes: Tensor, uniforms: Tensor) -> None:
        """Load `scenes` [K] into environments `ids` [K] with the physics that `uniforms` [K,D] draw."""
        c = self.cfg
        draw = {name: uniforms[:, column].squeeze(1) for name, column in self.columns.items()}
        mass = scaled(c.mass, draw["mass"]) if c.mass.on else torch.ones_like(draw["mass"])
        friction = scaled(c.friction, draw["friction"]) if c.friction.on else None
        self.binding.load(self.sim, ids, scenes, mass, friction)
        if c.contact_time.on:
            geoms = torch.tensor(self.binding.target_geoms, device=ids.device)
            times = scaled(c.contact_time, draw["contact_time"]).unsqueeze(1)
            solref = self.sim.field("geom_solref")
            solref[ids.unsqueeze(1), geoms, 0] = times.to(solref).expand(-1, len(geoms))
        for item, name, group in ((c.arm_gain, "arm_gain", joints.WBC), (c.hand_gain, "hand_gain", np.r_[joints.HAND])):
            if item.on:
                self._write_gain(ids, torch.as_tensor(group), scaled(item, draw[name]))

    def _write_gain(self, ids: Tensor, actuators: Tensor, factor: Tensor) -> None:
        at = (ids.unsqueeze(1), actuators.unsqueeze(0))
        gain, bias = self.sim.field("actuator_gainprm"), self.sim.field("actuator_biasprm")
        factor = factor.to(gain)
        gain[(*at, 0)] = self._gain[actuators, 0].to(gain) * factor.unsqueeze(1)
        bias[at] = self._bias[actuators].to(bias) * factor.view(-1, 1, 1)


def scaled(item: Range, uniform: Tensor) -> Tensor:
    """Uniform numbers in [0, 1) stretched to the range; its middle where it is switched off."""
    if not item.on:
        return torch.full_like(uniform, (item.low + item.high) / 2)
    return item.low + (item.high - item.low) * uniform
