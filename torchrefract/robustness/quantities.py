"""The physical quantity by which each scene of `torchrefract.presets` is stated."""

from torchrefract.robustness.evaluate import Quantity

QUANTITIES = {
    "cheap_dashcam": Quantity("k1", "", False, lambda params: params.coefficients[:, 0]),
    "cape_town_fog": Quantity("visibility", "m", False, lambda params: params.visibility),
    "night_fog": Quantity("visibility", "m", False, lambda params: params.children[0].visibility),
    "limpopo_sun_glare": Quantity("scattered sunlight", "%", True, lambda params: 100 * params.scatter),
    "highveld_heat_haze": Quantity("road hotter than air", "K", True, lambda params: params.children[0].difference),
    "highveld_telephoto": Quantity("tilt", "microradians", True, lambda params: params.tilt),
    "unpaved_road": Quantity("visibility", "m", False, lambda params: params.children[0].visibility),
}
