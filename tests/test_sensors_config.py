"""Presets are read by the configuration's own converter and mean what their names say."""

from pathlib import Path

import pytest
import yaml

from stages.convert import ConfigError, convert, defaults
from wbm.sensors.config import DepthNoise, SensorsConfig

PRESETS = Path(__file__).parent.parent / "conf" / "sensors"


def merged(base: dict, over: dict) -> dict:
    """As composition does it: presets change single keys of the schema's defaults."""
    both = {
        k: merged(base[k], v) if isinstance(v, dict) and isinstance(base.get(k), dict) else v for k, v in over.items()
    }
    return base | both


def load(name: str) -> SensorsConfig:
    preset = yaml.safe_load((PRESETS / f"{name}.yaml").read_text())
    return convert(SensorsConfig, merged(defaults(SensorsConfig), preset), "sensors")


def test_exact_is_the_default():
    assert load("exact") == SensorsConfig()


def test_realistic_switches_every_model_on():
    cfg = load("realistic")
    assert cfg.depth.noise == DepthNoise()
    # The published figure: about 3.8 mm at 1 m; 0.08 px over 446.9 px and 50 mm give 3.6 mm.
    assert cfg.depth.noise.axial(cfg.depth.hfov_deg) == pytest.approx(3.6e-3, rel=0.01)
    assert min(cfg.lidar.noise.sigma, cfg.lidar.noise.drop, cfg.lidar.noise.sparsity) > 0
    assert cfg.depth.extrinsic.sigma_rot > 0
    assert cfg.depth_cloud.delay.active
    assert cfg.lidar_cloud.delay.active


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"depth": {"wdith": 3}}, "did you mean 'width'"),
        ({"depth": {"noise": {"drop": 1.5}}}, "chances"),
        ({"lidar": {"step_hz": 0}}, "positive"),
        ({"depth_cloud": {"delay": {"delay_min": 3}}}, "delay_min"),
        ({"lidar_cloud": {"crop_min": [9, 9, 9]}}, "crop_min"),
    ],
)
def test_wrong_values_are_named(value, words):
    with pytest.raises(ConfigError, match=words):
        convert(SensorsConfig, value, "sensors")
