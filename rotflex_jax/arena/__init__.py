"""The arena: recordings with a known truth, on which methods that search for missing effects are scored.

    rf.arena.score("my_method.py:answer", records=12, seed=7)

A method is a function from training and validation recordings to an answer: names of effects, "nothing
missing" or "unexplained". It sees neither truth nor seed.

* `scores` - scores of methods on records that are drawn from a seed; `problems` draws them;
* `method` - input and possible answers of a method, which runs in a separate process;
* `entrants` - methods of the arena itself; they use `rivals` and `evolution`;
* `marking` - compares an answer with the hidden effects;
* `simulator` - the independent simulator; `wrong_worlds` - machines whose model has several errors;
* `measured` - the measured machines, with all directions of fit and test.
"""

import lazy_loader

# The simulator needs numba, and the entrants need JAX; a name is loaded when it is used.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "entrants": ["ENTRANTS", "Entrant"],
        "problems": ["Problem"],
        "scores": ["Marks", "MethodScore", "Scores", "score"],
    },
)
