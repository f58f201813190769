"""The arena: recordings of a known truth, on which methods that look for missing effects are scored.

    rf.arena.score("my_method.py:answer", records=12, seed=7)

A method is a function from training and validation recordings to an answer: names of effects, "nothing
missing" or "unexplained". It sees neither truth nor seed.

* `scores` - scores of methods on records drawn from a seed; `problems` draws them;
* `method` - what a method is given and may answer, in a process of its own;
* `entrants` - methods that come with the arena; `rivals` and `evolution` are what they rest on;
* `marking` - one answer beside what was hidden;
* `simulator` - the independent simulator; `wrong_worlds` - machines that are wrong in more ways than one;
* `measured` - every direction of the measured machines.
"""

import lazy_loader

# The simulator needs numba and the entrants JAX; a name is loaded when it is asked for.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "entrants": ["ENTRANTS", "Entrant"],
        "problems": ["Problem"],
        "scores": ["Marks", "MethodScore", "Scores", "score"],
    },
)
