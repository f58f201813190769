"""The palette of all figures and drawings; importing it loads nothing that draws."""

INK, MUTED, FAINT, AXIS = "#1f2933", "#66727f", "#d5dbe1", "#aeb7c0"
MEASURED, BASELINE, FINAL, NOISE = "#9aa5b1", "#c8452f", "#0f6f86", "#5b6570"
# Line of a baseline beside the solid one of a final model, so that no colour is needed to tell them apart.
BASELINE_DASH = (6, 1.5, 1, 1.5)
BASELINE_LINE = (0, BASELINE_DASH)
# Of further lines, in this order.
FURTHER = ("#d98e04", "#7a5aa6", "#5f8f3a", "#b5587f")
# Backgrounds: a stretch of time that is pointed at, and cells of a map without data.
HIGHLIGHT, NO_DATA = "#f3efe2", "#eceff2"


def stage_colours(count: int) -> tuple[str, ...]:
    """One colour per stage of a search: the baseline's, those of the stages between, the final one's."""
    if count == 1:
        return (BASELINE,)
    between = (FURTHER[k % len(FURTHER)] for k in range(count - 2))
    return (BASELINE, *between, FINAL)
