"""Every prim, attribute and primvar name of the stage convention, once."""

FACE_API = "FacepipeFaceAPI"
ANCHOR_API = "FacepipeAnchorAPI"
BONE_LIMITS_API = "FacepipeBoneLimitsAPI"
LANDMARKS_API = "FacepipeLandmarksAPI"
POSE_API = "FacepipePoseAPI"
RECIPE_API = "FacepipeRecipeAPI"
REGION_API = "FacepipeRegionAPI"
SLIDER_API = "FacepipeSliderAPI"

ATTACH_JOINT = "facepipe:attachJoint"
ATTRIBUTION = "facepipe:attribution"
VERSION = "facepipe:version"
ANCHOR = "facepipe:anchor"
BONE_COEFFICIENTS = "facepipe:boneCoefficients"
LIMITS_LOWER = "facepipe:boneLimits:lower"
LIMITS_UPPER = "facepipe:boneLimits:upper"
RECIPE_VERB = "facepipe:recipe:verb"
RECIPE_SOURCES = "facepipe:recipe:sources"
RECIPE_DIGESTS = "facepipe:recipe:digests"
RECIPE_OPTIONS = "facepipe:recipe:options"
RECIPE_VERSION = "facepipe:recipe:version"

REGION_PRIMVAR = "facepipe:region:"  # a primvar, so "primvars:" comes before it in full attribute names
SEAM_RESIDUAL = "facepipe:seamResidual"  # a primvar: float per point, millimetres
LANDMARKS_PREFIX = "facepipe:landmarks:"
SLIDER_PREFIX = "facepipe:slider:"

MATERIALS_SCOPE = "Materials"
ANIMATIONS_SCOPE = "Animations"
