// Pinocchio's regressor in a C++ loop: what a well-written user of the library has. Compiled by
// tests/benchmarks/peers.py against the headers of the pin wheel and Eigen.

#include <cstdint>
#include <string>

#include <pinocchio/fwd.hpp>  // first: it widens limits of Boost

#include <pinocchio/algorithm/regressor.hpp>
#include <pinocchio/multibody.hpp>

using Eigen::Vector3d;
using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

namespace {

struct Loop {
    pinocchio::Model model;
    pinocchio::Data data;
};

pinocchio::JointModel joint_model(int64_t kind, const Vector3d &axis)
{
    using namespace pinocchio;
    switch (kind) {
    case 0: return JointModelRX();
    case 1: return JointModelRY();
    case 2: return JointModelRZ();
    case 3: return JointModelRevoluteUnaligned(axis);
    case 4: return JointModelPX();
    case 5: return JointModelPY();
    case 6: return JointModelPZ();
    case 7: return JointModelPrismaticUnaligned(axis);
    default: return JointModelFreeFlyer();
    }
}

}  // namespace

// `placement` (joints, 12): rotation row by row, then translation.
extern "C" void *loop_make(int64_t joints, const int64_t *kind, const int64_t *parent,
                           const double *axis, const double *placement, const double *gravity)
{
    auto *loop = new Loop;
    for (int64_t j = 0; j < joints; j++) {
        const double *p = placement + 12 * j;
        pinocchio::SE3 at(Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(p),
                          Eigen::Map<const Vector3d>(p + 9));
        loop->model.addJoint(parent[j], joint_model(kind[j], Eigen::Map<const Vector3d>(axis + 3 * j)),
                             at, "joint" + std::to_string(j));
    }
    loop->model.gravity.linear() = Eigen::Map<const Vector3d>(gravity);
    loop->data = pinocchio::Data(loop->model);
    return loop;
}

extern "C" void loop_free(void *handle) { delete static_cast<Loop *>(handle); }

// Y (samples, nv, 10 joints) in C order.
extern "C" void loop_run(void *handle, int64_t samples, const double *q, const double *v,
                         const double *a, double *Y)
{
    auto *loop = static_cast<Loop *>(handle);
    const auto nq = loop->model.nq, nv = loop->model.nv, width = 10 * (loop->model.njoints - 1);
    for (int64_t k = 0; k < samples; k++) {
        const Eigen::Map<const Eigen::VectorXd> qk(q + k * nq, nq), vk(v + k * nv, nv),
            ak(a + k * nv, nv);
        Eigen::Map<RowMajor>(Y + k * nv * width, nv, width) =
            pinocchio::computeJointTorqueRegressor(loop->model, loop->data, qk, vk, ak);
    }
}
