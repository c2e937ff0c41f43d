// The extension module `clamber._core`: each part binds itself.
#include <nanobind/nanobind.h>

#include "bindings.h"

NB_MODULE(_core, m) {
    m.doc() = "Native core: kinematics, distances, postures, paths, statics.";
    clamber::bind_polygon(m);
    clamber::bind_statics(m);
    clamber::bind_geometry(m);
    clamber::bind_planes(m);
    clamber::bind_model(m);
    clamber::bind_posture(m);
    clamber::bind_spline(m);
    clamber::bind_balance(m);
    clamber::bind_servo(m);
}
