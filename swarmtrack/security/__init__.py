"""Authentication: the team's CA, certificates, signing keys and roster.

All certificates are issued by one CA. A certificate lets a process onto the team's links under its name (`drone-3`),
and every receiver enforces which keys each name may use (`transport.access_control`). A relaying router could still
forge messages, so each drone also signs its announcement (Ed25519), and the roster, signed by the CA, lists the public
keys.
"""
