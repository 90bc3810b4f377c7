"""`swarmtrack keys`: the team's CA, a folder of keys for each drone, and who has which until when."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from swarmtrack.arguments import add_action, add_folder
from swarmtrack.clock import SystemClock

EXAMPLE = """\
for example:
  swarmtrack keys init keys --team swarm
  swarmtrack keys issue keys 1 2 3 monitor
  scp -r keys/drone-1 drone-1.local:keys/          # and so on: each gets its own folder and no other
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EXAMPLE
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")

    init = add_action(actions, "init", "make the team's CA")
    init.add_argument("--team", default="swarm", metavar="NAME", help="network.team (default: %(default)s)")

    issue = add_action(actions, "issue", "make keys and a certificate for each of NAME")
    add_folder(issue, "--out", "where to create the key folders (default: the CA's)")
    issue.add_argument(
        "--days", type=_days, metavar="N", help="how long a certificate is valid (default: 90)"
    )
    renew_or_force = issue.add_mutually_exclusive_group()
    renew_or_force.add_argument(
        "--renew",
        action="store_true",
        help="new certificates for keys already issued (no NAME: for all)",
    )
    for overwriting in (init, renew_or_force):
        overwriting.add_argument("--force", action="store_true", help="overwrite keys")

    revoke = add_action(
        actions, "revoke", "remove a name from the roster: drones with the new roster ignore it"
    )

    listing = add_action(actions, "list", "names with keys, their fingerprints and expiry dates")

    for action in (init, issue, revoke, listing):
        add_folder(action, "folder", "the CA's folder; it stays with you")
    for action in (issue, revoke):
        action.add_argument(
            "names",
            nargs="*" if action is issue else "+",
            metavar="NAME",
            help="a drone's ID, monitor[-NAME] or router-NAME",
        )


def _days(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 0 < int(text) <= 3650):
        raise argparse.ArgumentTypeError(f"found {text}, expected a whole number of days, 1 … 3650")
    return int(text)


def run(args: argparse.Namespace) -> int:
    """Raises KeysError."""
    ACTIONS[args.action](args, datetime.fromtimestamp(SystemClock().utc(), UTC))
    return 0


def _init(args: argparse.Namespace, now: datetime) -> None:
    from swarmtrack.security.authority import create_authority

    authority = create_authority(args.folder, args.team, now, args.force)
    until = _date(authority.certificate.not_valid_after_utc)
    print(f"{args.folder}: the CA of team {authority.roster.team!r}, until {until}")
    print(f"Keep {args.folder / 'ca.key'} on this machine only.")
    print(f"Next: swarmtrack keys issue {args.folder} 1 2 3 monitor")


def _issue(args: argparse.Namespace, now: datetime) -> None:
    from swarmtrack.errors import KeysError
    from swarmtrack.security.authority import CERTIFICATE_DAYS, open_authority
    from swarmtrack.security.names import from_user

    authority = open_authority(args.folder)
    days = args.days or CERTIFICATE_DAYS
    wanted = [from_user(name) for name in args.names]
    if args.renew:
        if args.out is not None:
            raise KeysError("--out with --renew, expected --renew alone: it needs only the CA's folder")
        outcome = authority.renew(wanted or authority.roster.names, now, days=days)
        for name, folder in outcome.folders.items():
            print(
                f"{folder / f'{name}.pem'}: copy it to {name} in place of the old one, and restart its agent"
            )
        return
    if not wanted:
        raise KeysError("no name given, expected a drone's ID, monitor[-NAME] or router-NAME")
    outcome = authority.issue(wanted, now, out=args.out, days=days, force=args.force)
    for name, folder in outcome.folders.items():
        print(f"{folder}: copy this folder to {name}, and to no other machine")
    _tell_outdated(args.folder, outcome.outdated, "reject new members")


def _revoke(args: argparse.Namespace, now: datetime) -> None:
    from swarmtrack.security.authority import open_authority
    from swarmtrack.security.names import from_user

    authority = open_authority(args.folder)
    for name in map(from_user, args.names):
        outcome = authority.revoke(name)
        print(
            f"{name} is removed from the roster. Its certificate is still valid: do not use this name again before it "
            "expires"
        )
        _tell_outdated(args.folder, outcome.outdated, f"still accept {name}")


def _list(args: argparse.Namespace, now: datetime) -> None:
    from swarmtrack.security.authority import open_authority

    authority = open_authority(args.folder)
    roster, until = authority.roster, _date(authority.certificate.not_valid_after_utc)
    print(f"team {roster.team}, roster number {roster.number}, CA until {until}")
    print(f"{'name':<16} {'valid until':<17} {'days':>5}  {'certificate, SHA-256':<20}  signing key, Ed25519")
    for entry in authority.issued():
        left = (entry.expires - now).days
        signing = "-" if entry.signing_key is None else entry.signing_key.hex()[:20]
        print(
            f"{entry.name:<16} {_date(entry.expires):<17} {left:>5}  {entry.fingerprint[:20]:<20}  {signing}"
        )


def _tell_outdated(folder: Path, outdated: tuple[str, ...], without: str) -> None:
    if outdated:
        print(
            f"The roster is new: copy roster.toml and roster.sig from {folder} into the keys of {', '.join(outdated)} "
            f"and restart their agents. Without it they {without}."
        )


def _date(moment: datetime) -> str:
    return f"{moment:%Y-%m-%d %H:%M}Z"


ACTIONS: dict[str, Callable[[argparse.Namespace, datetime], None]] = {
    "init": _init,
    "issue": _issue,
    "revoke": _revoke,
    "list": _list,
}
