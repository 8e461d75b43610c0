"""The verb `correct` of the `warp-deform` command."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from warp_deform.command.main import CommandOptions, Outcome
from warp_deform.quiet import quiet_warp

from ..correction.settings import CorrectSettings

__all__ = ["CorrectOptions", "correct"]


@dataclass(frozen=True, kw_only=True)
class CorrectOptions(CorrectSettings, CommandOptions):
    """Let a policy play while a teacher says in every state what it would have done (DAgger).

    `train` on the new folder learns from the teacher's labels and the demonstrations, or, of an
    agent that learns what actions lead to, from what the policy did. The same command goes on where
    it was stopped.
    """


def correct(options: CorrectOptions) -> Outcome:
    """Correct a policy."""
    from ..correction.correct import CorrectConfig
    from ..correction.correct import correct as correct_policy

    quiet_warp()
    report = correct_policy(options.configure(CorrectConfig))
    text = (
        f"{options.out}: {report.labels} labels by {report.teacher} in {report.corrected} of "
        f"{report.episodes} episodes, of which the policy solved {report.solved}"
    )
    if report.equal_demonstrations is not None:
        text += f"; {report.equal_demonstrations:.1f} demonstrations hold as many actions"
    text += (
        f"; with {report.before_labels} actions and labels of {report.before} earlier episodes, in "
        f"{report.seconds:.1f} s"
    )
    failure = None
    if not report.corrected:
        failure = (
            f"the teacher labelled none of {report.episodes} episodes; "
            "try another --teacher or --seed"
        )
    return Outcome(data=asdict(report), text=text, failure=failure)
