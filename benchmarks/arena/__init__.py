"""The arena: recordings of a known truth, on which a discovery method can be marked.

The simulator here shares no line with the package under test. Data made by the model that later
explains it prove nothing, so this one steps differently (20 us, implicit midpoint), treats dry
friction as the set-valued law it is and play in the gear as two inertias that meet, and knows
nothing of the fitted parametrisation.

* `arena.plant` - the rotary flexible joint with every hidden law built in; its rooms are
  `tables` (all coefficients), `voltage`, `torques`, `friction`, `motion` (one step), `gear`,
  `sensors` and `compiled`;
* `arena.hidden` - names, ports, default sizes, and what no recording can tell apart;
* `arena.laws` - from a name and parameters to the plant's tables;
* `arena.excite` - the input voltages;
* `arena.records` - `make_record`: plant + hidden effects + input -> a recording and its truth;
* `arena.closed_loop` - the same plant under a controller (`control`), with a laboratory's sensors;
* `arena.wrong_worlds` - `world`: three such runs of a machine that is wrong in more than one way;
  `seen` says whether what it hides is visible.
"""
