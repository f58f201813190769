"""Recordings with a known truth, from a simulator that shares no code with the rest of the package.

Data from the model that is later fitted to them would prove nothing. This simulator therefore integrates
differently (steps of 20 us, implicit midpoint rule), treats dry friction as a set-valued law and play in the
gear as a contact between two inertias, and does not use the parameters of the models. It imports nothing from
the rest of the package; a test checks this.

* `plant` - the rotary flexible joint with all hidden effects; it uses `tables` (all coefficients), `voltage`,
  `torques`, `friction`, `motion` (one step), `gear`, `sensors` and `compiled`;
* `hidden` - names, ports and default sizes of the effects, and which effects no recording can distinguish;
* `laws` - from a name and parameters to the plant's tables;
* `excite` - the input voltages;
* `records` - `make_record`: plant + hidden effects + input -> a recording and its truth;
* `draws` - pairs and triples of effects;
* `machine` - the plant as a machine that is driven sample by sample;
* `closed_loop` - the plant under a controller (`control`), with the sensors of a laboratory;
* `seen` - whether a hidden effect is visible in a run.
"""
