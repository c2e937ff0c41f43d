// Small fixed-size linear algebra: vectors, rotations, quaternions (w, x, y, z).
#pragma once

#include <algorithm>
#include <array>
#include <cmath>

namespace clamber {

struct Vec3 {
    double x = 0.0, y = 0.0, z = 0.0;

    double& operator[](int i) { return (&x)[i]; }
    double operator[](int i) const { return (&x)[i]; }
    Vec3 operator-() const { return {-x, -y, -z}; }
    Vec3& operator+=(const Vec3& o) { x += o.x; y += o.y; z += o.z; return *this; }
    Vec3& operator-=(const Vec3& o) { x -= o.x; y -= o.y; z -= o.z; return *this; }
    Vec3& operator*=(double s) { x *= s; y *= s; z *= s; return *this; }
};

inline Vec3 operator+(Vec3 a, const Vec3& b) { return a += b; }
inline Vec3 operator-(Vec3 a, const Vec3& b) { return a -= b; }
inline Vec3 operator*(Vec3 a, double s) { return a *= s; }
inline Vec3 operator*(double s, Vec3 a) { return a *= s; }
inline double dot(const Vec3& a, const Vec3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(const Vec3& a, const Vec3& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline double square(const Vec3& a) { return dot(a, a); }
inline double norm(const Vec3& a) { return std::sqrt(square(a)); }
inline Vec3 read3(const double* p) { return {p[0], p[1], p[2]}; }
inline void write3(const Vec3& a, double* p) { p[0] = a.x; p[1] = a.y; p[2] = a.z; }

// Row-major; columns are the axes of the frame that it turns into the outer one.
struct Mat3 {
    double m[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};

    double& operator()(int r, int c) { return m[3 * r + c]; }
    double operator()(int r, int c) const { return m[3 * r + c]; }
    Vec3 row(int r) const { return {m[3 * r], m[3 * r + 1], m[3 * r + 2]}; }
    Vec3 col(int c) const { return {m[c], m[3 + c], m[6 + c]}; }
};

inline Vec3 operator*(const Mat3& R, const Vec3& v) {
    return {R.m[0] * v.x + R.m[1] * v.y + R.m[2] * v.z,
            R.m[3] * v.x + R.m[4] * v.y + R.m[5] * v.z,
            R.m[6] * v.x + R.m[7] * v.y + R.m[8] * v.z};
}
// R' v
inline Vec3 tmul(const Mat3& R, const Vec3& v) {
    return {R.m[0] * v.x + R.m[3] * v.y + R.m[6] * v.z,
            R.m[1] * v.x + R.m[4] * v.y + R.m[7] * v.z,
            R.m[2] * v.x + R.m[5] * v.y + R.m[8] * v.z};
}
inline Mat3 operator*(const Mat3& A, const Mat3& B) {
    Mat3 C;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            C(i, j) = A(i, 0) * B(0, j) + A(i, 1) * B(1, j) + A(i, 2) * B(2, j);
    return C;
}
inline Mat3 transposed(const Mat3& A) {
    return {{A.m[0], A.m[3], A.m[6], A.m[1], A.m[4], A.m[7], A.m[2], A.m[5], A.m[8]}};
}
inline Mat3 read9(const double* p) {
    Mat3 R;
    std::copy(p, p + 9, R.m);
    return R;
}

struct Quat {
    double w = 1.0, x = 0.0, y = 0.0, z = 0.0;
};

inline Quat readq(const double* p) { return {p[0], p[1], p[2], p[3]}; }
inline Quat conjugate(const Quat& q) { return {q.w, -q.x, -q.y, -q.z}; }
inline Quat operator*(const Quat& a, const Quat& b) {
    return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z,
            a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
            a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
            a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}
inline Quat normalized(const Quat& q) {
    const double n = std::sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
    if (!(n > 1e-15)) return {};
    return {q.w / n, q.x / n, q.y / n, q.z / n};
}
inline Mat3 matrix(const Quat& q) {
    const double w = q.w, x = q.x, y = q.y, z = q.z;
    return {{w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y),
             2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x),
             2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z}};
}
// Of the turn by `angle` about a unit axis.
inline Quat axis_angle(const Vec3& axis, double angle) {
    const double s = std::sin(0.5 * angle);
    return {std::cos(0.5 * angle), s * axis.x, s * axis.y, s * axis.z};
}
// The rotation vector of a unit quaternion, of length at most pi.
inline Vec3 rotation_vector(const Quat& q) {
    Vec3 v{q.x, q.y, q.z};
    const double s = norm(v);
    if (s < 1e-15) return {2 * q.x, 2 * q.y, 2 * q.z};
    double angle = 2.0 * std::atan2(s, q.w);
    if (angle > M_PI) angle -= 2.0 * M_PI;
    return v * (angle / s);
}

}  // namespace clamber
