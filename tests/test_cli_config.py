"""The configuration: agreement with a real `@hydra.main` process, strict types, suites, completion, code digests."""

import json
import os
import random
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from stages import completion, compose, plan
from stages.code import code_of
from stages.convert import ConfigError, convert
from stages.registry import Stage, slot
from wbm.artifacts.digest import plain
from wbm.artifacts.store import Store

REPOSITORY = Path(__file__).resolve().parent.parent
ENV = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
LINES = 500 if os.environ.get("WBM_FULL") else 12


def override_line(rng):
    """A random line of one to three overrides, right and wrong ones."""
    keys = compose.all_keys()
    values = ["1", "0.5", "true", "null", "abc", "[1,2]", "{a:1}", "'quoted text'", "1e-3", "-3", "${seed}", "${nope}",
              "", "a b", '"x=y"', "[side]", "inf", "[0.1,0.2]", "1,2", "range(3)", "str(5)", "int('7')"]  # fmt: skip
    line = []
    for _ in range(rng.randint(1, 3)):
        kind = rng.random()
        key = rng.choice(keys)
        if kind < 0.15:
            group = rng.choice(compose.groups())
            line.append(f"{group}={rng.choice([*compose.presets(group), 'nothing'])}")
        elif kind < 0.25:
            line.append(f"{key}x={rng.choice(values)}")
        elif kind < 0.32:
            line.append(f"~{key}")
        elif kind < 0.40:
            new = rng.choice([key, "extra", "inputs.assets", "env.nothing", "note"])
            line.append(f"{rng.choice(['+', '++'])}{new}={rng.choice(values)}")
        elif kind < 0.45:
            line.append(rng.choice(["seed", "=1", "a b=c", "seed==1", "[x]=1", "~profile", "seed=[1", "-x"]))
        else:
            default = current(key)
            guess = json.dumps(default).replace(" ", "") if rng.random() < 0.6 else rng.choice(values)
            line.append(f"{key}={guess}")
    return line


def current(key, cache={}):  # noqa: B006
    tree = cache.setdefault("tree", plain(compose.compose().config))
    for part in key.split("."):
        tree = tree[part]
    return tree


def test_the_resolved_configuration_agrees_with_hydra_main():
    rng = random.Random(7)
    lines = [override_line(rng) for _ in range(LINES)]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    done = subprocess.run(
        [sys.executable, REPOSITORY / "tests/hydra_main.py"], input=text, env=ENV, capture_output=True, text=True
    )
    theirs = [json.loads(answer) for answer in done.stdout.splitlines()]
    assert len(theirs) == len(lines), done.stderr[-2000:]
    good = 0
    for line, their in zip(lines, theirs, strict=True):
        try:
            ours = json.loads(json.dumps(plain(compose.compose(line).config)))
        except ConfigError as error:
            assert "\n" not in str(error)
            ours = None
        assert json.dumps(ours) == json.dumps(their), line
        good += ours is not None
    assert LINES / 10 < good < LINES * 9 / 10, "the lines should be a mixture of right and wrong ones"


@dataclass(frozen=True)
class Inner:
    rate: float = 1.0
    sizes: tuple[int, ...] = (1,)
    pair: tuple[float, float] = (0.0, 1.0)
    mode: Literal["a", "b"] = "a"
    maybe: int | None = None

    def __post_init__(self):
        if self.rate < 0:
            raise ValueError(f"rate is {self.rate}; it cannot be negative")


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    table: dict[str, Inner] = field(default_factory=dict)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"inner": {"rat": 1}}, "unknown key 'inner.rat'; did you mean 'rate'?"),
        ({"inner": {"rate": "fast"}}, "inner.rate=fast: must be a number, not str"),
        ({"inner": {"rate": True}}, "inner.rate=True: must be a number, not bool"),
        ({"inner": {"sizes": [1, 2.5]}}, "inner.sizes[1]=2.5: must be an integer, not float"),
        ({"inner": {"pair": [1]}}, "inner.pair=[1]: needs 2 values, got 1"),
        ({"inner": {"mode": "c"}}, "inner.mode=c: choose one of a, b"),
        ({"inner": {"maybe": "x"}}, "inner.maybe=x: must be an integer, not str"),
        ({"inner": {"rate": -1}}, "inner: rate is -1.0; it cannot be negative"),
        ({"inner": 3}, "inner=3: must be a mapping, not int"),
        ({"table": {"k": {"rate": "x"}}}, "table.k.rate=x: must be a number, not str"),
    ],
)
def test_wrong_values_are_named(values, message):
    with pytest.raises(ConfigError) as error:
        convert(Outer, values)
    assert str(error.value) == message


def test_right_values_are_converted():
    got = convert(Outer, {"inner": {"rate": 2, "sizes": [3, 4], "maybe": 5}, "table": {"k": {"mode": "b"}}})
    assert got == Outer(Inner(2.0, (3, 4), maybe=5), {"k": Inner(mode="b")})
    assert isinstance(got.inner.rate, float)


def test_every_profile_composes():
    for profile in compose.presets("profile"):
        assert compose.compose([f"profile={profile}"]).choices["profile"] == profile


def suite_stages():
    teacher = Stage(
        "train-teacher",
        "toy",
        "teacher",
        ("teacher",),
        (),
        lambda cfg: cfg.teacher.name,
        print,
        ("teacher", "teachers"),
    )
    rollouts = Stage(
        "generate-rollouts", "toy", "rollouts", ("seed",), (slot("teacher/*"),), lambda cfg: "main", print, None
    )
    return [teacher, rollouts]


@pytest.fixture
def no_code(monkeypatch):
    monkeypatch.setattr(plan, "_code", lambda module: code_of("wbm"))


def composer(overrides):
    return compose.compose(overrides).config


def test_a_suite_is_one_node_for_each_teacher(tmp_path, no_code):
    nodes = plan.build(suite_stages(), ["seed=1"], composer, Store.open(tmp_path))
    assert [node.ref for node in nodes] == ["teacher/top_down", "teacher/side", "rollouts/main"]
    assert sorted(nodes[2].upstream) == ["teacher/side", "teacher/top_down"]
    assert nodes[1].overrides[-1] == "teacher=side" and nodes[1].config.teacher.grasp == "side"
    nodes = plan.build(suite_stages(), ["teachers=[side]"], composer, Store.open(tmp_path))
    assert [node.ref for node in nodes] == ["teacher/side", "rollouts/main"]
    with pytest.raises(ConfigError, match=r"write teachers=\[side\]"):
        plan.build(suite_stages(), ["teacher=side"], composer, Store.open(tmp_path))


def test_one_teacher_is_chosen_by_its_preset(tmp_path, no_code):
    stages = suite_stages()
    (node,) = plan.single(stages[0], stages, ["teacher=side"], composer, Store.open(tmp_path))
    assert node.ref == "teacher/side"


def test_a_stage_reads_declared_sections_only(tmp_path, no_code):
    node = plan.build(suite_stages(), [], composer, Store.open(tmp_path))[0]
    assert node.view.teacher.name == "top_down"
    with pytest.raises(AttributeError, match="train-teacher reads section 'ppo'; add it to SECTIONS"):
        _ = node.view.ppo


def complete(*words):
    return completion.complete(words)


def test_completion_offers_commands_options_groups_keys_and_values():
    assert complete("dis") == ["distill"]
    assert complete("run", "--fo") == ["--force"]
    assert complete("run", "--launcher", "s") == ["slurm"]
    assert complete("plan", "--until", "d") == ["deploy-export", "distill"]
    assert complete("run", "prof") == ["profile="]
    assert complete("run", "profile=l") == ["profile=laptop"]
    assert complete("run", "-m", "teacher=side,t") == ["teacher=side,top_down"]
    assert complete("run", "distill.l") == ["distill.lr=", "distill.lr_final="]
    assert complete("run", "sens") == ["sensors.", "sensors="]
    assert complete("run", "env.end_on_collision=") == ["env.end_on_collision=false", "env.end_on_collision=true"]
    assert complete("artifacts", "ve") == ["verify"]
    assert complete("completion", "f") == ["fish"]


@pytest.fixture
def package(tmp_path):
    """A package `p`: stage -> library -> kernel, a data file, and a module that nobody imports."""
    files = {
        "__init__.py": "",
        "stage.py": "from p.library import solve\n\ndef run():\n    from p import lazy\n    return solve(lazy)\n",
        "library.py": 'from . import kernel\n\nF = "facts.yaml"\n\ndef solve(x):\n    "Doc."\n    return kernel.k(x)\n',
        "kernel.py": "import numpy\n\ndef k(x):\n    return x + 1\n",
        "lazy.py": 'CLASS = "p.named:Runner"\n',
        "named.py": "class Runner:\n    pass\n",
        "stranger.py": "x = 1\n",
        "facts.yaml": "mass: 1\n",
    }
    (tmp_path / "p").mkdir()
    for name, text in files.items():
        (tmp_path / "p" / name).write_text(text)
    return tmp_path


def test_a_key_covers_exactly_what_a_stage_can_reach(package):
    def digest():
        return code_of("p.stage", base=package, roots=("p",))

    before = digest()
    names = ["__init__.py", "facts.yaml", "kernel.py", "lazy.py", "library.py", "named.py", "stage.py"]
    assert sorted(before.files) == [f"p/{name}" for name in names]
    assert "numpy" in before.versions
    for name, text in (
        ("stranger.py", "x = 2\n"),
        ("kernel.py", "# a comment\nimport numpy\n\n\ndef k(x):\n    '''Doc.'''\n    return (x + 1)\n"),
        ("library.py", (package / "p/library.py").read_text().replace("Doc.", "Other words.")),
    ):
        (package / "p" / name).write_text(text)
        assert digest().digest == before.digest, name
    for name, text in (
        ("kernel.py", "import numpy\n\ndef k(x):\n    return x + 2\n"),
        ("facts.yaml", "mass: 2\n"),
        ("named.py", "class Runner:\n    speed = 1\n"),
    ):
        last = digest()
        (package / "p" / name).write_text(text)
        now = digest()
        assert {f for f in now.files if now.files[f] != last.files[f]} == {f"p/{name}"}


def test_worker_counts_and_notes_are_no_part_of_a_key():
    few, many = (compose.compose([f"rollouts.workers={n}"]).config.rollouts for n in (1, 4))
    assert few != many
    assert plain(few, key_only=True) == plain(many, key_only=True)


def test_an_entry_of_a_mapping_needs_no_plus_sign():
    for line in ("inputs.assets=assets/mine", "+inputs.assets=assets/mine", "++inputs.assets=assets/mine"):
        assert compose.compose([line]).config.inputs == {"assets": "assets/mine"}
