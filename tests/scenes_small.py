"""A small world that the scene tests share: made once in a process."""

from functools import cache

from wbm.scenes.config import ObjectsConfig, ScenesConfig
from wbm.scenes.generate import generate_scenes
from wbm.scenes.model import SceneModel, SceneModelConfig
from wbm.scenes.objects import stack_objects
from wbm.scenes.procedural import draw_objects

OBJECTS = ObjectsConfig(count=68)
SCENES = ScenesConfig(count=5, test_count=2)


@cache
def small_objects():
    return stack_objects(draw_objects(OBJECTS, 1))


@cache
def small_model(slots="native"):
    return SceneModel(small_objects(), SceneModelConfig(slots=slots))


@cache
def small_bank():
    return generate_scenes(small_model(), SCENES, 0)
