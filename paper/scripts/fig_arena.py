"""What was hidden in the arena and what was answered -> figures/arena.png. Reads results/B0.json."""

from sources import claims, save

from rotflex_jax.text.colours import BASELINE, FINAL, INK, MEASURED
from rotflex_jax.text.plotting import blank, styled

COLUMNS = 3
# Marker, colour and words of each kind of answer; shapes tell them apart without colour.
RIGHT, LISTED, WRONG = ("s", FINAL, "right"), ("D", MEASURED, "listed as alike"), ("X", BASELINE, "wrong")


def label(effects: list[list[str]]) -> str:
    """What was hidden, in words."""
    return " and ".join(f"{e.replace('_', ' ')} at {p}" for e, p in effects) or "nothing"


def answers() -> dict[str, list[tuple[str, str, str]]]:
    """Label -> kind of answer of each record."""
    found: dict[str, list[tuple[str, str, str]]] = {}
    for r in claims.records():
        kind = RIGHT if r["first"] else LISTED if r["inside"] else WRONG
        found.setdefault(label(r["effects"]), []).append(kind)
    for r in claims.records(hidden=False):
        name = "nothing" if not r["effects"] else f"{label(r['effects'])} (already in the model)"
        found.setdefault(name, []).append(WRONG if r["rounds"] else RIGHT)
    for r in claims.records(outside=True):
        right = r["verdict"] == "unexplained"
        found.setdefault(f"{label(r['effects'])} (no name)", []).append(RIGHT if right else WRONG)
    return found


@styled
def draw():
    rows = list(answers().items())
    most = max(len(kinds) for _, kinds in rows)
    height = -(-len(rows) // COLUMNS)
    figure = blank(10.0, 0.2 * height + 0.6)
    axes = figure.subplots(1, COLUMNS, squeeze=False)[0]
    for k, ax in enumerate(axes):
        part = rows[k * height : (k + 1) * height]
        for y, (_, kinds) in enumerate(part):
            for kind in (RIGHT, LISTED, WRONG):
                x = [i for i, mine in enumerate(kinds) if mine == kind]
                ax.scatter(x, [y] * len(x), 26, marker=kind[0], color=kind[1], label=kind[2], linewidths=0)
        ax.set_yticks(range(len(part)), [name for name, _ in part], fontsize=7, color=INK)
        ax.set_xlim(-0.6, max(most, 4) - 0.4)
        ax.set_ylim(height - 0.4, -0.6)
        ax.set_xticks([])
        ax.grid(False)
        ax.tick_params(length=0)
        for side in ax.spines.values():
            side.set_visible(False)
    handles, names = axes[0].get_legend_handles_labels()
    seen = dict(zip(names, handles, strict=True))
    figure.legend(seen.values(), seen, loc="outside upper left", ncols=3)
    return figure


if __name__ == "__main__":
    save(draw(), "arena")
