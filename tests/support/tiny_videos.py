"""Videos of 32 x 32 pixels that OpenCV cannot write: a bare H.264 stream, and a Matroska file of a varying rate."""

from __future__ import annotations

import base64
import gzip

H264 = base64.b64decode(
    "AAAAAWdkAAqscgRJbARAAAADAEAAABkDxIlhGAAAAAFo6EODksiwAAABZYiBAAQ/eXD314aDZD/YTLhn5I7j0oKhdI4/6XIXN6/JbQbpGME//3eh"
    "k0QIc6TxOIs3H1sT3wpF7sd+V2eV2gEg0bulAb/7x+1THhQkGOrVBSdh73JXbjXBpChXCOfcbfKGd/5wQAiJxzqOGULqK1MmBM8aIIW1bX4lJagp"
    "f/tNbdXx9+TZuf//9XTFBx0AAAABQZoILYhD/8GAAAAAAUGaEEvwIGTKYQh/wYEAAAABQZoYaTwIHkymBCX/xIAAAAABQZogiXwIH5MpgEJfxIEA"
    "AAABQZooqbwIH+TKYAQp/8WBAAAAAUGaMMn8CB/5MpgAQp/FgQAAAAFBmjjojwIH/5MpgAELf8uBAAAAAUGaQQifAgf/5MpgABC3y4AAAAABQZpJ"
    "KK8CB//5MpgAAQt/y4A="
)
"""Ten frames of a test pattern."""
_PACKED = base64.b64decode(
    "H4sIAAAAAAACA5Nyvb94sVNbI6PTdyD+1Mji9LmRw6mpIzexpCi/ODvRqR0o1NrIJBHckM7IAAJMXoK+s0sO7G9hXhuwzXd3d/DqFlHPlWnBaxoX"
    "QnhiIeuygbwzvrt7gDyhkMPpwWuaGKMgXJng3UDJJia9NxDTGIIZqA9A7lm2vyWqK8VU6/rGZn4nB9+GFp/EsrRwRzDl0tnh0O8AVgpyrEPH/pbn"
    "prz31kGdVHm9kbH4aAfUMMY5jQxKW+c0l+aldDQytPWHxfsGuLqb6HsG++s7Bgc0NzIqP25uYfyzIPTBhA2NCrsaFWY1MoVuaAnd2cgY+q6RAeZR"
    "JgaG5EXzgOZtAAowbu0UBpIg4xUYjvR2MHxlZGERcQYF1tX9LefeTLlSXHwm+UB3MsIZ6Semuy5ud/Vz9ndxDXJp7wJ6JFkhtyA13ST9xELXxR0u"
    "oUGOIZ7+fi7tkw0MrEDIUM8ABhjknbeVft3f0iOS0vW8kWHxokYGhgagoZsZBNiB1DaB5I/d0vXSub8ZGO676eT+yd3+fvGERgZFkMXbAj5+3g8U"
    "zweJOINFAhPhIsxLwSJxhQiR4xCRhxARUIxP399iV9Swanf/5kaG7V3AlPaxiXHLh0ZOAMj0mpF+AgAA"
)
VARYING_RATE = gzip.decompress(_PACKED)
"""Five frames within the second that its header announces: three at its beginning, two at its end; of 30 Hz."""
