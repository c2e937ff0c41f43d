#include "bindings.h"

namespace clamber {

void bind_geometry(nb::module_&) {}

}  // namespace clamber
