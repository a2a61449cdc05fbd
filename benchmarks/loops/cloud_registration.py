"""Baseline: registration of point clouds by Open3D (FPFH with RANSAC or FGR, then ICP).

The points are the centres of the Gaussians. Results are reproducible: the bridge runs Open3D on
one thread, and its random generator is seeded before every use.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.slam.loops.registration.quality import check_alignment
from toolkit.slam.loops.registration.result import RegistrationResult, failed
from toolkit.slam.loops.registration.views import ViewRenderer
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.alignment.data import ResidualScales

Array = NDArray[np.float64]


# Points are the centres of Gaussians of this opacity, averaged over voxels of half this edge.
_MIN_OPACITY, _VOXEL_M = 0.5, 0.05
_HYPOTHESES = 50_000
# Minimum fraction of the source's points that lie on the target's surface.
_MIN_FITNESS = 0.1
# Number of views of the source in which the result is checked.
_VIEWS = 5
# Minimum number of points of a cloud.
_MIN_POINTS = 100
# Radii in voxels, as in Open3D's examples.
_NORMAL_RADIUS, _FEATURE_RADIUS, _MATCH_DISTANCE = 2.0, 5.0, 1.5
_ICP_ITERATIONS = 50
# Maximum correspondence distances of the ICP stages, in voxels. Coloured ICP needs a large one:
# Open3D computes colour gradients from the neighbours within twice this distance. With few
# neighbours they are noisy, and the result can be wrong by decimetres.
_ICP_VOXELS, _COLOURED_VOXELS = (2.0, 1.0, 0.5), 2.0


class CloudRegistration:
    """Registers the point clouds of two submaps; see Registrar.

    Args:
        search: global registration from FPFH features, by RANSAC or fast global registration.
        icp: refinement.
        renderer: renders the views in which the result is checked; default renderer if None.
        seed: random seed of RANSAC and fast global registration.

    Raises (from `register`):
        DependencyError: Open3D cannot be loaded.
    """

    def __init__(
        self,
        search: Literal["ransac", "fast"] = "ransac",
        icp: Literal["point-to-plane", "coloured"] = "point-to-plane",
        renderer: ViewRenderer | None = None,
        seed: int = 0,
    ) -> None:
        self.search, self.icp, self.seed = search, icp, seed
        self.renderer = renderer or ViewRenderer()

    def register(
        self, target: Submap, source: Submap, T_target_source: Array | None = None
    ) -> RegistrationResult:
        """See Registrar; with an initial pose, global registration is skipped."""
        o3d = open3d()
        method = f"{self.icp} ICP"
        if T_target_source is None:
            method = f"FPFH {self.search} + {method}"
        target_cloud, source_cloud = self._cloud(o3d, target), self._cloud(o3d, source)
        if min(len(target_cloud.points), len(source_cloud.points)) < _MIN_POINTS:
            return failed(method, "a submap has too few solid Gaussians", T_target_source)
        start = T_target_source
        if start is None:
            start = self._global_registration(o3d, target_cloud, source_cloud)
        before = self.renderer.renders
        found, information = self._icp(o3d, target_cloud, source_cloud, start)
        T = se3.orthonormalise(np.asarray(found.transformation))
        if len(found.correspondence_set) == 0:
            return failed(method, "the clouds have no point in common", T_target_source)
        check = check_alignment(target, source, T, self.renderer, _VIEWS)
        enough = found.fitness >= _MIN_FITNESS
        return RegistrationResult(
            T_target_source=T,
            converged=bool(enough),
            inliers=check.inliers,
            residual=ResidualScales(float("nan"), float(found.inlier_rmse)),
            overlap=check.overlap,
            class_agreement=check.class_agreement,
            information=information,
            iterations=0,
            renders=self.renderer.renders - before,
            method=method,
            reason="" if enough else f"only {100 * found.fitness:.0f} % of the points fit",
        )

    def _cloud(self, o3d: ModuleType, submap: Submap) -> Any:
        """Centres of the opaque Gaussians with colours and normals, oriented to the cameras."""
        opaque = submap.gaussians.select(submap.gaussians.opacities >= _MIN_OPACITY)
        cloud = o3d.geometry.PointCloud(
            o3d.utility.Vector3dVector(opaque.means.detach().numpy().astype(np.float64))
        )
        colours = opaque.colours.detach().clamp(0.0, 1.0).numpy().astype(np.float64)
        cloud.colors = o3d.utility.Vector3dVector(colours)
        cloud = cloud.voxel_down_sample(_VOXEL_M / 2.0)
        positions = [keyframe.T_map_camera[:3, 3] for keyframe in submap.keyframes]
        return self._with_normals(o3d, cloud, np.mean(positions, axis=0))

    def _with_normals(self, o3d: ModuleType, cloud: Any, camera_position: Array) -> Any:
        radius = _NORMAL_RADIUS * _VOXEL_M
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius, 30))
        if len(cloud.points):
            cloud.orient_normals_towards_camera_location(camera_position)
        return cloud

    def _global_registration(self, o3d: ModuleType, target: Any, source: Any) -> Array:
        """Estimate T_target_source [4, 4] from FPFH features, without an initial pose."""
        registration, voxel_m = o3d.pipelines.registration, _VOXEL_M
        sampled = [cloud.voxel_down_sample(voxel_m) for cloud in (source, target)]
        search = o3d.geometry.KDTreeSearchParamHybrid(_FEATURE_RADIUS * voxel_m, 100)
        features = [registration.compute_fpfh_feature(cloud, search) for cloud in sampled]
        distance = _MATCH_DISTANCE * voxel_m
        o3d.utility.random.seed(self.seed)
        if self.search == "fast":
            option = registration.FastGlobalRegistrationOption(
                use_absolute_scale=True, maximum_correspondence_distance=distance
            )
            found = registration.registration_fgr_based_on_feature_matching(
                *sampled, *features, option
            )
        else:
            found = registration.registration_ransac_based_on_feature_matching(
                *sampled,
                *features,
                True,
                distance,
                registration.TransformationEstimationPointToPoint(False),
                3,
                [
                    registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                    registration.CorrespondenceCheckerBasedOnDistance(distance),
                ],
                registration.RANSACConvergenceCriteria(_HYPOTHESES, 0.999),
            )
        return np.asarray(found.transformation, dtype=np.float64)

    def _icp(self, o3d: ModuleType, target: Any, source: Any, start: Array) -> tuple[Any, Array]:
        """Run ICP at decreasing distances; return Open3D's result and the information [6, 6]."""
        registration = o3d.pipelines.registration
        criteria = registration.ICPConvergenceCriteria(max_iteration=_ICP_ITERATIONS)
        planes = (
            registration.registration_icp,
            registration.TransformationEstimationPointToPlane(),
        )
        colours = (
            registration.registration_colored_icp,
            registration.TransformationEstimationForColoredICP(),
        )
        stages = [(*planes, voxels) for voxels in _ICP_VOXELS]
        if self.icp == "coloured":
            stages.append((*colours, _COLOURED_VOXELS))
        T, voxel_m = np.array(start, dtype=np.float64), _VOXEL_M
        for align, method, voxels in stages:
            try:
                found = align(source, target, voxels * voxel_m, T, method, criteria)
            except RuntimeError:  # no correspondences
                break
            T = np.asarray(found.transformation, dtype=np.float64)
        found = registration.evaluate_registration(source, target, voxel_m, T)
        count = registration.get_information_matrix_from_point_clouds(source, target, voxel_m, T)
        return found, scaled_information(np.asarray(count), T, float(found.inlier_rmse))


def scaled_information(
    count: NDArray[np.float64], T_target_source: Array, rmse_m: float
) -> NDArray[np.float64]:
    """Inverse covariance of x in T exp(x), translation first, from Open3D's matrix.

    Open3D sums J^T J over matched points, with rotation first, a left perturbation, and a standard
    deviation of one metre per point.

    Args:
        count: [6, 6] Open3D's information matrix.
        rmse_m: root mean square distance of the matched points.
    """
    if not rmse_m > 0:
        return np.zeros((6, 6))
    order = [3, 4, 5, 0, 1, 2]
    A = se3.adjoint(T_target_source)
    return A.T @ count[np.ix_(order, order)] @ A * (3.0 / rmse_m**2)
