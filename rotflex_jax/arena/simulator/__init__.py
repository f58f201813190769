"""Recordings of a known truth, by a simulator that shares no line with the rest of the package.

Data made by the model that later explains it prove nothing, so this one steps differently (20 us, implicit
midpoint), treats dry friction as the set-valued law it is and play in the gear as two inertias that meet, and
knows nothing of the fitted parametrisation. It imports nothing of the package; a test holds it to that.

* `plant` - the rotary flexible joint with every hidden law built in, of `tables` (all coefficients),
  `voltage`, `torques`, `friction`, `motion` (one step), `gear`, `sensors` and `compiled`;
* `hidden` - names, ports, default sizes, and what no recording can tell apart;
* `laws` - from a name and parameters to the plant's tables;
* `excite` - the input voltages;
* `records` - `make_record`: plant + hidden effects + input -> a recording and its truth;
* `draws` - pairs and triples of effects;
* `machine` - the plant as a machine that is driven sample by sample;
* `closed_loop` - the plant under a controller (`control`), with a laboratory's sensors;
* `seen` - whether a run shows a hidden effect.
"""
