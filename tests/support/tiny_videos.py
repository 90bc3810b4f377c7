"""Videos of a few pixels that OpenCV cannot write: bare streams, one of a varying rate, and with longer sound."""

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


def _unpacked(text: str) -> bytes:
    return gzip.decompress(base64.b64decode(text))


LONGER_SOUND = {
    "a.mkv": _unpacked(
        "H4sIAAAAAAACA63WS0wTQRwG8JltERIOFB9IjMZGb8ZAQWKIp3Zp1RpKsdtS5ILYSk0a1FgweiDpdFe6gAbUIIpEHmuMDyRVUoiucZuIpiFE"
        "PYk3ICa+YhAfBD3h7rQEORgv/0m7m5l2f/vNt5fdZJuWJLaFYHZR/X4nevYHyWIjYkNd46kToWAdG1WXzhEmnwsHMNJG9rVcx/XGhCKUfqrl"
        "HXI7d0/YYL9Tzw2RgdQszz0cVGeTDvm8OlvrfhbghiL4YWq6mZPVHyPZzV9SGuIQ/NDy3FIEY5arbMfUAz6HNTvCQnnd6XqvhZ6sraK5L0z/"
        "qoU1zygC/3lX7XA60tkpgkPPxTSGewnaFu/lm477RYJaOqpqHZW2fSWFds5ZaOEqeYK3v+OFjIVZNNMZI4bHxNBDGE9M8Dwi2DNH0PJGGYR8"
        "gzdUL6Yu4HjrOvWo8UY0fkFEHiQw633LCZxThFlJwKxO0GqhCQrLi6vuCnhi7CZPGC2C/sAgmr3YR3BcNL8y0yuP+IlBy6A9BPOgIuCce/5Q"
        "aNKXaPet7C+Q7LZJUVtFmdNqc1mjbWpDPmPDyaOBkkBywCaJVo/L4rY7K6zRyybTHu1TVGBaHigUmljFMYFk19+cmOaK/4UVF5iKdqexrWWj"
        "TfYtirDx0tKLDwRJkxGEwksL+eOuXH360Xqnmxdfzv2+H5SfBmvmvva8keX38eH/LvQjJHURVVM3PIIMmepp1JCQrkwr2k32w92knSC/1uro"
        "wZm9Gt0JR6vaW9CgSRrUldCCYiMkjXdSmqMd4GOgdCel3anUMch68S/QoD9pUA/tgDFD0kw1patoB4wI2QHzGjToExrUSzvQ5UPSOiOlq2kH"
        "usOgtEDpQ6nUtyHr1c1DavpSUC0MqiUhtQwDqFYNqvWDah8htTUmUO0MqJaA1DKzQLVKUO0qmKa9QHcrQh7LeeWOEYLG2tQX928RpmaeeP8A"
        "/umeuc0LAAA="
    ),
    "a.flv": _unpacked(
        "H4sIAAAAAAACA3PzCWNkZWBg4ARiBiEGRh4GCGBi4MrP800tSXRJLEnkAArwMHCklBYllmTm5zE4MJwBgbMMrOWZKSUZDA4GUF1sGamZ6Rkl"
        "CAHessyU1PwUoBlArakMDhlZEHHOtKLE3FSImApULQ9YbXJ+SmpyZgrQDpgRiaUpmUhGyENl+MHixYm5BTlQg452NGDIFGdWpSK5r7gktSg1"
        "nxFoGVgNhmUcaZkwPaskoGLAoGEUBwaBKZSv9v+xwBEgzewB4vk4+rqa6BkqaCTmFGQkKhhohoaGYhEDqnQAmmHGwGACNUPoiDrMjFAsAJu5"
        "QKWOQNfwMzCkQKKLoYWBg0NQ7c+fP3///wOKSEGcmQF3pj8eK3DY4AAxYy7cjDISnQkygxMcbCdAupSAruTh4DBUALJFIGZfhJs9lwyzwcEI"
        "TrSQYDxCZjByMjDqwBwogeJARku4A2+QG4CMuUSZgTcAGSfA3KeC6r5FFJkNCcBr8AC8Tn4AfoE50ADFgUxclAcgkx3lAcgUAXOfDar7iikP"
        "QKblVAhApj0wB3qgOvA25QHIzE95ADIrwNwXguI+ZhfKA5C5ggoByNwCc2ACqgPXUCEAH1AhAF/A3JeD4j4WUcoDkMWTsgCEOKSW8oBi2Uip"
        "Z4BmPKM8QFilqBAgrH6UBwhrE+UBwrqdCgHymgoBwiZPeYCwBVMeIGwdlAcI2x5qBMgHygOEXYU4z2ABCDMiKTXDjIG9l7gAwWEIJEDYD1LB"
        "M18pN4NDiyIzAAADt4YMDQAA"
    ),
    "a.ts": _unpacked(
        "H4sIAAAAAAACA9WYTUhUURTHz5VRGWzo3Zk3zjha2EIEV6OT5lDUWDAThGDa5MdOZJKQQAINJGOColy0iKBFi6ikZTUV02agnmAtpA8IFF05"
        "sxFcZLORiILnOU9czKoPEOd/F3e4s3jvXN7v/N7/3URMG3Sy2ERqjshWNqnfafO0V1XF45fGU6PuvtTlyYsjqXDrlaunFuzyGokYGUQZj1M7"
        "qSK1vHS9sjFGoodrr8gEnNoLVCRDJleBd9F85mGxvGvvovBUD1E6eY324Pb8qPN883TlIar+dpNXGcVTdsbHs3DQSPN3blOSblSYI7x8TUY1"
        "/7wxrNn7q++YGQ3MjAZmpvUJd+vd9T1h5j/YckcWBZuz+Tgz4wVmxgvMTJswMzsNw8xUkzDTawkzPmBmfMDMRISZrIZhxpoQZvrYM10qrGK8"
        "sNT49uttedjeDM73ahc5w9+/Ov3j88bPZ2O5t2NDG98fLOVya9nnf/zjEUe7Xb5OQildbjX97XW49rYXZEONnb2zZ0xgz5jAnjksnvnwFMUz"
        "NVXvxTPn5N2kNfA3nx+Ydz8w7+3C+3IUhvduv/CedPJ7LTAztcDMdAgz659gmLmXEmbOW5LFIiVZzL14HSiLmcBZrB04iwWAPRMA9swR8cyv"
        "YRjPrGTFM/3OuykIzEwQmJlOZkbt20RhxtNYKcwMOGdLdcDM1AEzExVmDs7AMHMhKcwMOmdLHSV5pubrY6A8EwDOM524eUZ7gc8JQsCODOE6"
        "UkVLPOP5MgfkmRCwZ44CfzfVA/dqPXCvHivp1f0fC0C9egC4V48DZwIfcCZoAPZMA7BnTmx7hvKOZ/SCAvJM+FaZ9Oq/7mkL2kdcw9wpAAA="
    ),
    "b.mpg": _unpacked(
        "H4sIAAAAAAACA+3aMUvDQBQH8HdJaYRW0jaIgoNGly4qDoKj4CguYhDaIQ7i1KJ7K/gFHIqg0M0PUCQURFqUgBYn6aRdBDM5OIgg0tblvCYK"
        "vSLOGv5/Arl34Q0/bngchIjVTGLETsorRKxOcbGImNzznlx3Uux47Gqe1IKTJNUuibrKKGFw7o2J9TkN0ZJ4E+m8I97MyKyVEv7GBu/s93ZS"
        "u355LJctqWSjcin3MrmXyb2K3KvIvYrcq0i9A5IohUUS/1FyGTV0jiAIgiB+xGBwtQ+T1O0D/r54vbU8k1p/EPNjxLIse6/9+P00C/cN5+zO"
        "ecu0muVurti+yGXH89mJhUqxe3p084c/u3DBBRdccMEF18Bn8u//qn0Y3P9d7cUkbfMWxwgXXHDBBRdcIXYF81+bneub/7F0HscIF1xwwQUX"
        "XCF2BfM/lt7pm//6VAXHCBdccMEFF1whdgXzf/hV/5r/asOk5PMqjhEuuP6vq/e/Z2Qa/3siCPJLPgF2y3dhADAAAA=="
    ),
}
"""By their names: one second of video with two seconds of silence, with three in the last."""
WITH_A_RATE = {
    "b.m2v": _unpacked(
        "H4sIAAAAAAACA2NgYNzMyCAg9v//AwkGBsatIl0MjAxAwLiDgYPBgQHE4f//AyTT//+zYwOQwSgcFTRRACwT/v83SGRrozxUSqgALD4dh/h1"
        "7OKM4jjEcZjPiMN8RhzmM+EwnwmL+QBldS3fEAEAAA=="
    ),
    "b.m4v": _unpacked(
        "H4sIAAAAAAACA2NgYNzAyMDAuLVTGEgyALECw5HeDsapDC1MIslA7mYGAXYgtU3AQOPp9vcgVkCF4H4wvQFK/4DQgQZQGiofCJUPhMoHQeWD"
        "gPIAMDOwbncAAAA="
    ),
}
"""Bare streams of ten frames that hold their rate, 50 Hz."""
