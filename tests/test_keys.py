"""What reruns what on the real stages: a copy of the sources is edited, settings are changed, keys are compared."""

import re
import shutil
from pathlib import Path

import pytest

from stages import plan, registry
from stages.code import code_of
from stages.compose import compose
from wbm.artifacts.store import Store

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture
def sources(tmp_path):
    for package in ("wbm", "stages"):
        shutil.copytree(REPOSITORY / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def digests(sources):
    return {name: code_of(module, base=sources).digest for name, module in registry.MODULES.items()}


def changed(sources, path, edit):
    """Stages whose code digest changes by an edit, which is taken back."""
    before, text = digests(sources), (sources / path).read_text()
    fresh = edit(text)
    assert fresh != text, "the edit must change something"
    (sources / path).write_text(fresh)
    after = digests(sources)
    (sources / path).write_text(text)
    return {name for name in before if before[name] != after[name]}


def with_comment(text):
    return re.sub(r"^(def |class )", r"# a comment\n\1", text, count=1, flags=re.MULTILINE)


def with_docstring(text):
    return text.replace('"""', '"""More words. ', 1)


def with_constant(text):
    return text + "\nA_NEW_CONSTANT = 1\n"


def test_comments_and_docstrings_rerun_nothing(sources):
    paths = [path.relative_to(sources) for path in sources.rglob("*.py")]
    for path in [f"stages/{m.split('.')[1]}.py" for m in registry.MODULES.values()] + ["wbm/kernels/rays.py"]:
        assert Path(path) in paths
        assert changed(sources, path, with_comment) == set(), path
        assert changed(sources, path, with_docstring) == set(), path


@pytest.mark.parametrize(
    ("path", "stages"),
    [
        # distill plays episodes of its own in rounds of DAgger
        ("wbm/kernels/rays.py", {"generate-rollouts", "distill", "evaluate"}),
        ("wbm/kernels/wbc_qp.py", {"train-teacher", "generate-rollouts", "distill", "evaluate"}),
        ("wbm/learning/distill.py", {"distill"}),
        ("wbm/report/page.py", {"evaluate"}),
        ("wbm/learning/export.py", {"deploy-export"}),
        ("wbm/scenes/pictures.py", {"prepare-assets"}),
        ("stages/train_teacher.py", {"train-teacher"}),
        ("wbm/artifacts/store.py", set()),
        ("stages/plan.py", set()),
        ("wbm/report/viewer.py", set()),
    ],
)
def test_a_changed_module_reruns_exactly_the_stages_that_use_it(sources, path, stages):
    assert changed(sources, path, with_constant) == stages


@pytest.mark.parametrize(
    ("override", "stages"),
    [
        ("distill.lr=5e-4", {"distill"}),
        ("ppo.lr=5e-4", {"train-teacher"}),
        ("evaluation.episodes=7", {"evaluate"}),
        ("sensors.depth.width=40", {"generate-rollouts", "distill", "evaluate"}),
        ("scenes.count=3", {"prepare-assets"}),
        ("seed=9", {"prepare-assets", "train-teacher", "generate-rollouts", "distill", "evaluate"}),
        ("rollouts.workers=7", set()),
        ("evaluation.workers=7", set()),
        ("artifacts.wait=3", set()),
        ("note=hello", set()),
    ],
)
def test_a_setting_reruns_only_the_stages_that_read_it(tmp_path, override, stages):
    def sections(*lines):
        nodes = plan.build(registry.load_all(), lines, lambda lines: compose(lines).config, Store.open(tmp_path))
        return {(node.stage.name, node.name): node.sections for node in nodes}

    before, after = sections(), sections(override)
    assert {name for name, _ in before if before[name, _] != after[name, _]} == stages
