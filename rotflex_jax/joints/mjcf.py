"""A mechanism from one joint of an MJCF file, with or without a joint behind it."""

import os
from collections.abc import Iterable

from rotflex_jax import checks
from rotflex_jax.mechanism import Mechanism

IGNORABLE = ("forcerange", "ctrlrange", "ref", "springref", "tendon", "equality", "actuator")
"""What a file may say that can be left out on request."""


def load_mjcf(
    path: str | os.PathLike[str],
    joint: str | None = None,
    child: str | None = None,
    ignore: Iterable[str] = (),
) -> Mechanism:
    """A mechanism from one joint of an MJCF file, as a start of a fit or a search.

        (armature + inertia about the axis) q''
            = actuator - damping q' - frictionloss sign(q') - stiffness q - weight

    All that hangs on the joint is rigid at rest. With `child`, a joint about the same axis behind it, the two
    are a flexible joint of hub and arm. Inertias come from `<inertial>` or from simple shapes,
    attributes from classes of defaults; the actuator is a `motor`, `general`, `position`, `velocity` or
    `dcmotor`, its control the input. Ranges of joints and of goals, contacts and drawings are not read.
    MuJoCo itself is not needed. Not for a chain whose inertia depends on the angle of the child.

    Args:
        path: Of the file.
        joint: Name of the joint; None where the file has only one.
        child: Name of the joint behind it, for a flexible joint.
        ignore: What is left out where the file says it: `forcerange`, `ctrlrange`, `ref`, `springref`,
            `tendon`, `equality`, `actuator`.

    Returns:
        Mechanism with the port `hub` and the output `theta`, with a child `joint`, `arm` and `alpha` too; of
        a sliding joint the port `axis` and the output `position`.

    Raises:
        InputError: No such joint; what the file says and no effect can, by name; a file that declares a
            document type, includes others or is too large.

    Source: MuJoCo documentation, XML reference, body, inertial, joint, actuator.
    """
    left_out = tuple(checks.one_of(name, "ignore", IGNORABLE) for name in checks.names(ignore, "ignore"))
    from rotflex_jax.joints.mjcf_reader import mechanism_of  # XML is for those who read some

    return mechanism_of(path, joint, child, left_out)
