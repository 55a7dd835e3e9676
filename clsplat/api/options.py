"""`clsplat.TrainOptions`: the options of a training, checked and complete when they are made."""

from typing import TYPE_CHECKING, Any

from clsplat import options
from clsplat.schedule.plan import Schedule
from clsplat.schedule.registry import offered


class TrainOptions(options.TrainOptions):
    """The options of a training: those of `clsplat train` and its --config, as keywords.

    An option that is not given has the value that the schedule, the preset and the like set.

    Raises
    ------
    clsplat.ClsplatError : for an unknown option, a value out of its limits, or a contradiction.
    """

    if not TYPE_CHECKING:  # the fields are the keywords, for editors and type checkers

        def __init__(self, **given: Any) -> None:
            object.__setattr__(self, "_given", given)
            for name, value in vars(options.resolve({}, given)).items():
                object.__setattr__(self, name, value)


def resolved(given: options.TrainOptions | None, schedule: type[Schedule] | None = None) -> options.TrainOptions:
    """The options of a training, which follows a schedule that is given as a class.

    Parameters
    ----------
    given : by the user; None: all defaults.
    schedule : of another package or program; None: the one that the options name.
    """
    values = {} if given is None else dict(getattr(given, "_given", None) or vars(given))
    values.pop("_given", None)
    if schedule is not None:
        values["schedule"] = offered(schedule)
    return options.resolve({}, values)
