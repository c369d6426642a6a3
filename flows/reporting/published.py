"""Published few-view numbers: the CAT3D paper's Table 1 (PSNR dB, SSIM, LPIPS for 3, 6 and 9 views)."""

from __future__ import annotations

from typing import Any

_TABLE = {
    "realestate10k": {
        "Zip-NeRF*": "20.77/.774/.332 27.34/.906/.180 31.56/.947/.118",
        "ZeroNVS*": "19.11/.675/.422 22.54/.744/.374 23.73/.766/.358",
        "ReconFusion": "25.84/.910/.144 29.99/.951/.103 31.82/.961/.092",
        "CAT3D": "26.78/.917/.132 31.07/.954/.092 32.20/.963/.082",
    },
    "llff": {
        "Zip-NeRF*": "17.23/.574/.373 20.71/.764/.221 23.63/.830/.166",
        "ZeroNVS*": "15.91/.359/.512 18.39/.449/.438 18.79/.470/.416",
        "ReconFusion": "21.34/.724/.203 24.25/.815/.152 25.21/.848/.134",
        "CAT3D": "21.58/.731/.181 24.71/.833/.121 25.63/.860/.107",
    },
    "dtu": {
        "Zip-NeRF*": "9.18/.601/.383 8.84/.589/.370 9.23/.592/.364",
        "ZeroNVS*": "16.71/.716/.223 17.70/.737/.205 17.92/.745/.200",
        "ReconFusion": "20.74/.875/.124 23.62/.904/.105 24.62/.921/.094",
        "CAT3D": "22.02/.844/.121 24.28/.899/.095 25.92/.928/.073",
    },
    "co3d": {
        "Zip-NeRF*": "14.34/.496/.652 14.48/.497/.617 14.97/.514/.590",
        "ZeroNVS*": "17.13/.581/.566 19.72/.627/.515 20.50/.640/.500",
        "ReconFusion": "19.59/.662/.398 21.84/.714/.342 22.95/.736/.318",
        "CAT3D": "20.57/.666/.351 22.79/.726/.292 23.58/.752/.273",
    },
    "mipnerf360": {
        "Zip-NeRF*": "12.77/.271/.705 13.61/.284/.663 14.30/.312/.633",
        "ZeroNVS*": "14.44/.316/.680 15.51/.337/.663 15.99/.350/.655",
        "ReconFusion": "15.50/.358/.585 16.93/.401/.544 18.19/.432/.511",
        "CAT3D": "16.62/.377/.515 17.72/.425/.482 18.67/.460/.460",
    },
}

#: Rows {"dataset", "method", "split", "psnr_db", "ssim", "lpips"}, of the paper's own scenes and resolutions.
PUBLISHED: list[dict[str, Any]] = [
    {"dataset": dataset, "method": method, "split": split}
    | dict(zip(("psnr_db", "ssim", "lpips"), map(float, cell.split("/"))))
    for dataset, methods in _TABLE.items()
    for method, text in methods.items()
    for split, cell in zip(("3", "6", "9"), text.split())
]
