"""Colours of all figures and drawings; the import loads no plotting package."""

INK, MUTED, FAINT, AXIS = "#1f2933", "#66727f", "#d5dbe1", "#aeb7c0"
MEASURED, BASELINE, FINAL, NOISE = "#9aa5b1", "#c8452f", "#0f6f86", "#5b6570"
# Dashes of a baseline, since the line of a final model is solid: they differ without colours, too.
BASELINE_DASH = (6, 1.5, 1, 1.5)
BASELINE_LINE = (0, BASELINE_DASH)
# Colours of further lines, in this order.
FURTHER = ("#d98e04", "#7a5aa6", "#5f8f3a", "#b5587f")
# Background colours: a highlighted stretch of time, and cells of a map without data.
HIGHLIGHT, NO_DATA = "#f3efe2", "#eceff2"


def stage_colours(count: int) -> tuple[str, ...]:
    """One colour for each stage of a search: baseline, stages in between, final stage."""
    if count == 1:
        return (BASELINE,)
    between = (FURTHER[k % len(FURTHER)] for k in range(count - 2))
    return (BASELINE, *between, FINAL)
