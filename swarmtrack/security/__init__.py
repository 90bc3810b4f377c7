"""Who may speak as whom: the team's CA, certificates, signing keys and roster.

One CA vouches for everything. A certificate lets a process onto the team's links under its name (`drone-3`), and what
each name may say there is decided by every receiver (`transport.access_control`). A router that relays could still
invent things, so each drone also signs its announcement (Ed25519), and the roster, signed by the CA, says which key is
whose.
"""
