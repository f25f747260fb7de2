"""Reports what was trained."""

KIND = "evaluation"
SECTIONS = ("seed",)
INPUTS = ("policy:student",)


def name(cfg):
    return "main"


def run(cfg, inputs, draft, progress):
    rows = (inputs["policy"].path / "rows.txt").read_text()
    (draft.path / "report.html").write_text(f"<p>{rows}</p>")
    draft.metrics["success"] = 0.5
